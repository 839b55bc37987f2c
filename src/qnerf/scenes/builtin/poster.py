"""The built-in scene: ray traced at first use, then read from a cache."""

import contextlib
import os
import tempfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from qnerf.config.cache import cache_folder
from qnerf.scenes.base import LEAST_VIEWS, SCENES, Scene, digest, split_views
from qnerf.scenes.builtin.textures import encoded
from qnerf.scenes.builtin.tracer import BRIGHTEST
from qnerf.scenes.images import MOST_SCENE_BYTES
from qnerf.scenes.normalise import normalise
from qnerf.scenes.transforms import cameras_from

VERSION = "1"  # to be raised whenever other pictures would come out
FOCAL = 0.72  # focal length over the longer side of the image
CHUNK = 2**16  # rays traced at a time


@SCENES.register("poster")
def poster(
    *,
    path: str | None = None,
    downscale: int = 1,
    views: int = 226,
    width: int = 36,
    height: int = 64,
    supersample: int = 4,
    seed: int = 0,
) -> Scene:
    """A corner of a room with a framed poster, seen by a hand-held camera; exact depth. Needs no download.

    The pictures are kept in the folder $QNERF_CACHE, else $XDG_CACHE_HOME/qnerf, else ~/.cache/qnerf; where none can be
    written they are traced anew each time.

    Args:
        path: unused: the scene is built in.
        downscale: integer; images are traced at width // downscale x height // downscale.
        views: number of images.
        width, height: pixels.
        supersample: rays along each axis of a pixel.
        seed: of the camera's path.

    Raises:
        ValueError: an option is out of range, or `path` is given.
    """
    if path is not None:
        raise ValueError(f"scene=poster is built in and has no path, got {path!r}; for images use scene=nerfstudio")
    options = {"views": views, "width": width, "height": height, "supersample": supersample, "downscale": downscale}
    least = {"views": LEAST_VIEWS}
    for name, value in options.items():
        if value < least.get(name, 1):
            raise ValueError(f"scene=poster: {name} must be at least {least.get(name, 1)}, got {value}")
    if seed < 0:
        raise ValueError(f"scene=poster: seed must be at least 0, got {seed}")
    if downscale > min(width, height):
        raise ValueError(f"scene=poster: downscale={downscale} is larger than the images, {width} x {height} pixels")
    width, height = width // downscale, height // downscale
    if views * width * height * 7 > MOST_SCENE_BYTES:
        gigabytes = views * width * height * 7 / 2**30
        raise ValueError(f"scene=poster: {views} views of {width} x {height} pixels would need {gigabytes:.0f} GiB")

    arrays = _cached({"views": views, "width": width, "height": height, "supersample": supersample, "seed": seed})
    poses, transform = normalise(arrays["poses"].astype(np.float64))
    focal = FOCAL * max(width, height)
    lens = np.tile([focal, focal, width / 2, height / 2, 0, 0, 0, 0], (views, 1))
    train, held_out = split_views(views)
    return Scene(
        name="poster",
        images=torch.from_numpy(arrays["images"]),
        cameras=cameras_from(poses, lens, width, height),
        train=train,
        eval=held_out,
        names=[f"{view:0{len(str(views - 1))}d}" for view in range(views)],
        fingerprint=digest("poster", VERSION, np.array([views, width, height, supersample, seed])),
        transform=torch.from_numpy(transform),
        depth=torch.from_numpy(arrays["depth"] * np.float32(transform_scale(transform))),
    )


def transform_scale(transform: NDArray) -> float:
    """By how much a similarity (4, 4) stretches lengths."""
    return float(np.cbrt(np.linalg.det(transform[:3, :3])))


def render_views(*, views: int, width: int, height: int, supersample: int, seed: int) -> dict[str, NDArray]:
    """Traces the room: images (V, H, W, 3) uint8, depth (V, H, W) float32 in metres, poses (V, 3, 4) float64."""
    from qnerf.scenes.builtin.room import room, walk

    world, poses = room(), walk(views, seed)
    focal = FOCAL * max(width, height)
    fine_x = (np.arange(width * supersample) + 0.5) / supersample
    fine_y = (np.arange(height * supersample) + 0.5) / supersample
    spread = 1 / (focal * supersample)
    rows = max(CHUNK // (width * supersample**2), 1)  # of pixels

    def directions(pose: NDArray, x: NDArray, y: NDArray) -> NDArray:
        """Unit vectors (3, y * x) in the world through image points, row by row."""
        u = np.broadcast_to((x - width / 2) / focal, (len(y), len(x))).reshape(-1)
        v = np.broadcast_to(((y - height / 2) / focal)[:, None], (len(y), len(x))).reshape(-1)
        ray = pose[:, 0:1] * u - pose[:, 1:2] * v - pose[:, 2:3]
        return ray / np.sqrt((ray**2).sum(0))

    def one(view: int) -> tuple[NDArray, NDArray]:
        pose = poses[view]
        image, depth = np.empty((height, width, 3), np.uint8), np.empty((height, width), np.float32)
        for first in range(0, height, rows):
            last = min(first + rows, height)
            fine = directions(pose, fine_x, fine_y[first * supersample : last * supersample]).astype(np.float32)
            light = world.radiance(pose[:, 3:].astype(np.float32), fine, spread)
            light = np.minimum(light, np.float32(BRIGHTEST)).reshape(last - first, supersample, width, supersample, 3)
            image[first:last] = np.round(encoded(light.mean(axis=(1, 3))) * 255)
            centres = directions(pose, np.arange(width) + 0.5, np.arange(first, last) + 0.5)
            depth[first:last] = world.trace(pose[:, 3:], centres).distance.reshape(last - first, width)
        return image, depth

    with ThreadPoolExecutor(min(os.cpu_count() or 1, 16)) as pool:
        images, depths = zip(*pool.map(one, range(views)), strict=True)
    return {"images": np.stack(images), "depth": np.stack(depths), "poses": poses}


def _cached(options: Mapping[str, int]) -> dict[str, NDArray]:
    """The arrays of `render_views`, from the cache if they lie there whole."""
    key = digest(VERSION, np.array([options[name] for name in sorted(options)]))
    folder = cache_folder()
    if folder is None:
        return render_views(**options)
    file = folder / f"poster-{key}.npz"
    arrays = _load(file, options, key)
    if arrays is None:
        arrays = render_views(**options)
        _save(file, arrays | {"key": np.array(key)})
    return arrays


def _load(file: Path, options: Mapping[str, int], key: str) -> dict[str, NDArray] | None:
    shape = (options["views"], options["height"], options["width"])
    expected: dict[str, tuple[Any, tuple[int, ...]]] = {
        "images": (np.uint8, (*shape, 3)),
        "depth": (np.float32, shape),
        "poses": (np.float64, (shape[0], 3, 4)),
    }
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            if str(stored["key"]) != key:
                return None
            arrays = {name: stored[name] for name in expected}
    except Exception:  # absent, cut short, damaged: numpy and zipfile raise a dozen different things
        return None
    good = all(arrays[name].dtype == kind and arrays[name].shape == size for name, (kind, size) in expected.items())
    return arrays if good else None


def _save(file: Path, arrays: Mapping[str, NDArray]) -> None:
    """Writes the file in one piece or not at all: a cache that cannot be written is no error."""
    temporary = None
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(prefix=".poster-", suffix=".tmp", dir=file.parent)
        with os.fdopen(handle, "wb") as stream:
            np.savez(stream, **arrays)  # type: ignore[arg-type]
        os.replace(temporary, file)
    except OSError:
        if temporary is not None:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
