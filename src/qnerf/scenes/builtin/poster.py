"""The built-in scene: ray traced on first use, then read from a cache."""

import contextlib
import os
import tempfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from annotated_types import Interval
from numpy.typing import NDArray

from qnerf.config.bounds import Count
from qnerf.config.cache import cache_folder
from qnerf.scenes.base import MIN_VIEWS, SCENES, Cameras, Scene, digest, split_views
from qnerf.scenes.builtin.textures import encoded
from qnerf.scenes.builtin.tracer import MAX_RADIANCE
from qnerf.scenes.images import check_downscale
from qnerf.scenes.normalise import normalise

VERSION = "1"  # raise it whenever the images change
FOCAL = 0.72  # focal length / longer side of the image
CHUNK = 2**16  # rays traced at a time


@SCENES.register("poster")
def poster(
    *,
    path: str | None = None,
    downscale: Count = 1,
    views: Annotated[int, Interval(ge=MIN_VIEWS, le=10**6)] = 226,
    width: Count = 36,
    height: Count = 64,
    supersample: Annotated[int, Interval(ge=1, le=256)] = 4,
    seed: Annotated[int, Interval(ge=0, le=2**53)] = 0,
) -> Scene:
    """A corner of a room with a framed poster, seen by a hand-held camera, with exact depth. Needs no download.

    The images are cached in $QNERF_CACHE, else $XDG_CACHE_HOME/qnerf, else ~/.cache/qnerf. Without a writable folder
    they are traced anew each time.

    Args:
        path: must be None: the scene is built in.
        downscale: integer; images are traced at width // downscale x height // downscale.
        views: number of images.
        width, height: pixels.
        supersample: rays along each axis of a pixel.
        seed: of the camera's path.

    Raises:
        ValueError: an option is out of range, or `path` is not None.
    """
    if path is not None:
        raise ValueError(f"scene=poster is built in and has no path, got {path!r}; for images use scene=nerfstudio")
    options = {"views": views, "width": width, "height": height, "supersample": supersample, "seed": seed}
    check_downscale("scene=poster", downscale, width, height)
    width, height = width // downscale, height // downscale
    arrays = _cached(options | {"width": width, "height": height})
    poses, transform = normalise(arrays["poses"].astype(np.float64))
    focal = FOCAL * max(width, height)
    lens = np.tile([focal, focal, width / 2, height / 2, 0, 0, 0, 0], (views, 1))
    train, held_out = split_views(views)
    arrays["depth"] *= np.float32(np.cbrt(np.linalg.det(transform[:3, :3])))  # metres -> normalised world units
    return Scene(
        name="poster",
        images=torch.from_numpy(arrays["images"]),
        cameras=Cameras.from_arrays(poses, lens, np.array([width, height])),
        train=train,
        eval=held_out,
        names=[f"{view:0{len(str(views - 1))}d}" for view in range(views)],
        fingerprint=digest("poster", VERSION, np.array([views, width, height, supersample, seed])),
        transform=torch.from_numpy(transform),
        depth=torch.from_numpy(arrays["depth"]),
    )


def render_views(*, views: int, width: int, height: int, supersample: int, seed: int) -> dict[str, NDArray]:
    """Traces the room.

    Returns:
        images (V, H, W, 3) uint8, depth (V, H, W) float32 in metres, camera-to-world poses (V, 3, 4) float64 in metres.
    """
    from qnerf.scenes.builtin.room import room, walk

    rows = max(CHUNK // (width * supersample**2), 1)  # rows of pixels traced at a time
    images, depths = np.empty((views, height, width, 3), np.uint8), np.empty((views, height, width), np.float32)
    world, poses = room(), walk(views, seed)
    focal = FOCAL * max(width, height)
    fine_x = (np.arange(width * supersample) + 0.5) / supersample
    fine_y = (np.arange(height * supersample) + 0.5) / supersample
    ray_angle = 1 / (focal * supersample)  # radians between neighbouring rays

    def directions(pose: NDArray, x: NDArray, y: NDArray) -> NDArray:
        """Unit vectors (3, rows * columns) in the world through image points, row by row."""
        u = np.broadcast_to((x - width / 2) / focal, (len(y), len(x))).reshape(-1)
        v = np.broadcast_to(((y - height / 2) / focal)[:, None], (len(y), len(x))).reshape(-1)
        ray = pose[:, 0:1] * u - pose[:, 1:2] * v - pose[:, 2:3]
        return ray / np.sqrt((ray**2).sum(0))

    def trace_view(view: int) -> None:
        pose, image, depth = poses[view], images[view], depths[view]
        for first in range(0, height, rows):
            last = min(first + rows, height)
            fine = directions(pose, fine_x, fine_y[first * supersample : last * supersample]).astype(np.float32)
            light = world.radiance(pose[:, 3:].astype(np.float32), fine, ray_angle)
            light = np.minimum(light, np.float32(MAX_RADIANCE)).reshape(
                last - first, supersample, width, supersample, 3
            )
            image[first:last] = np.round(encoded(light.mean(axis=(1, 3))) * 255)
            centres = directions(pose, np.arange(width) + 0.5, np.arange(first, last) + 0.5)
            depth[first:last] = world.trace(pose[:, 3:], centres).distance.reshape(last - first, width)

    with ThreadPoolExecutor(min(os.cpu_count() or 1, 16)) as pool:
        for _ in pool.map(trace_view, range(views)):
            pass
    return {"images": images, "depth": depths, "poses": poses}


def _cached(options: Mapping[str, int]) -> dict[str, NDArray]:
    """The arrays of `render_views`, from the cache if an intact file is there."""
    key = digest(VERSION, np.array([options[name] for name in sorted(options)]))
    folder = cache_folder()
    if folder is None:
        return render_views(**options)
    file = folder / f"poster-{key}.npz"
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            return dict(stored)
    except Exception:  # no file, or a damaged one, which makes numpy and zipfile raise a dozen different errors
        arrays = render_views(**options)
        _save(file, arrays)
        return arrays


def _save(file: Path, arrays: Mapping[str, NDArray]) -> None:
    """Writes the file atomically. A cache that cannot be written is no error."""
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
