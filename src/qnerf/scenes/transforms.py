"""Reads transforms.json as written by nerfstudio, instant-ngp and the synthetic-NeRF scenes."""

import json
import math
import posixpath
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from qnerf.scenes.base import MIN_VIEWS, Cameras, Scene, digest
from qnerf.scenes.images import check_downscale, common_size, find_image, open_header, read_images
from qnerf.scenes.lens import invertible
from qnerf.scenes.normalise import normalise, rigid

MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
UNSUPPORTED = ("k3", "k4", "k5", "k6")
MAX_JSON_BYTES = 2**28


@dataclass(frozen=True)
class Frame:
    """One frame of a transforms file."""

    name: str  # file_path as written
    file: Path | None  # the image; None: missing
    pose: NDArray  # (3, 4) float64, camera-to-world in the source's world
    own: Mapping[str, Any]  # keys of this frame
    shared: Mapping[str, Any]  # keys of the whole file, overridden by the frame's

    @property
    def key(self) -> str:
        """The same for all spellings of one image's path."""
        return posixpath.normpath(self.name)


def find_transforms(path: str | Path, name: str, other: tuple[str, str]) -> Path:
    """The file `name` in the scene's folder.

    Args:
        other: a file of the other layout, and the scene reader that the error message then suggests.

    Raises:
        ValueError: the folder or the file does not exist.
    """
    folder = Path(path).expanduser()
    if not folder.is_dir():
        state = "is not a folder" if folder.exists() else "does not exist"
        raise ValueError(f"scene.path={str(path)!r} {state}; expected a folder with posed images")
    if not (folder / name).is_file():
        hint = f"; it has {other[0]}: use scene={other[1]}" if (folder / other[0]).is_file() else ""
        raise ValueError(f"scene.path={str(path)!r} has no {name}{hint}")
    return folder / name


def read_json(file: Path) -> dict[str, Any]:
    """The file's JSON object. ValueError unless it has a non-empty list `frames`."""
    try:
        if file.stat().st_size > MAX_JSON_BYTES:
            raise ValueError("more than 256 MiB")
        content = json.loads(file.read_bytes().decode("utf-8-sig"))
    except OSError as error:
        raise ValueError(f"{file} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{file} is not JSON: {str(error).splitlines()[0]}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{file}: expected a JSON object with a list 'frames', got {type(content).__name__}")
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise ValueError(f"{file} has no frames: expected a non-empty list 'frames'")
    return content


def read_frames(folder: Path, file: Path) -> list[Frame]:
    """All frames of a transforms file in the file's order, also those whose image is missing.

    Raises:
        ValueError: names the first frame with a missing or repeated file_path, or with a pose that is not rigid.
    """
    content = read_json(file)
    frames = []
    seen: set[str] = set()
    for index, source in enumerate(content["frames"]):
        if not isinstance(source, dict):
            raise ValueError(f"{file}: frame {index} must be an object, got {type(source).__name__}")
        name = source.get("file_path")
        if not isinstance(name, str) or not name:
            raise ValueError(f"{file}: file_path of frame {index} must be a file name, got {name!r}")
        label = f"{file}: frame {name!r}"
        if "transform_matrix" not in source:
            raise ValueError(f"{label} has no transform_matrix")
        try:
            pose = np.array(source["transform_matrix"], dtype=np.float64)
        except (ValueError, TypeError, OverflowError) as error:
            raise ValueError(f"{label}: transform_matrix must be 4 x 4 numbers") from error
        frame = Frame(name, find_image(folder, name), rigid(pose, label), source, content)
        if frame.key in seen:
            raise ValueError(f"{file} names image {name!r} twice")
        seen.add(frame.key)
        frames.append(frame)
    return frames


def with_images(folder: Path, frames: Sequence[Frame], skip_missing: bool) -> list[Frame]:
    """The frames whose image exists.

    Raises:
        ValueError: an image is missing and `skip_missing` is false, or fewer than three images exist.
    """
    missing = [frame for frame in frames if frame.file is None]
    if missing and not skip_missing:
        raise ValueError(
            f"{folder}: {len(missing)} of {len(frames)} images are missing, the first is {missing[0].name!r}; "
            "scene.skip_missing=true goes on with the rest"
        )
    existing = [frame for frame in frames if frame.file is not None]
    if len(existing) < MIN_VIEWS:
        hint = f" ({len(missing)} of {len(frames)} are missing)" if missing else ""
        raise ValueError(f"{folder}: expected at least {MIN_VIEWS} images, got {len(existing)}{hint}")
    return existing


def finite_number(keys: Mapping[str, Any], key: str, label: str) -> float | None:
    """keys[key] as a float; None if absent or null. ValueError unless it is a finite number."""
    value = keys.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= 1e12:
        raise ValueError(f"{label}: {key} must be a finite number, got {value!r}")
    return float(value)


def focal_lengths(keys: Mapping[str, Any], width: int, height: int, label: str) -> tuple[float | None, float | None]:
    """fx, fy in pixels, from fl_x, fl_y (pixels) or camera_angle_x, camera_angle_y (radians); None where both miss."""
    lengths: list[float | None] = []
    for axis, size in (("x", width), ("y", height)):
        length, angle = (finite_number(keys, f"{key}_{axis}", label) for key in ("fl", "camera_angle"))
        if length is not None and length <= 0:
            raise ValueError(f"{label}: fl_{axis} must be above 0, got {length:g}")
        if length is None and angle is not None:
            if not 0 < angle < math.pi:
                raise ValueError(f"{label}: camera_angle_{axis} must be between 0 and pi, got {angle:g}")
            length = 0.5 * size / math.tan(0.5 * angle)
        lengths.append(length)
    return lengths[0], lengths[1]


def intrinsics(frame: Frame, width: int, height: int, label: str) -> list[float]:
    """fx fy cx cy k1 k2 p1 p2 of a frame whose image has width x height pixels. Its own keys win over shared ones."""
    merged = {**frame.shared, **frame.own}
    model = merged.get("camera_model") or "OPENCV"
    if model not in MODELS or merged.get("is_fisheye"):
        name = "fisheye" if merged.get("is_fisheye") else repr(model)
        raise ValueError(f"{label}: camera model {name} is not supported; known: {', '.join(MODELS)}")
    for key in UNSUPPORTED:
        if finite_number(merged, key, label):
            raise ValueError(f"{label}: distortion {key}={merged[key]:g} is not supported; known: k1, k2, p1, p2")
    for key, size in (("w", width), ("h", height)):
        stated = finite_number(merged, key, label)
        if stated is not None and stated != size:
            raise ValueError(
                f"{label}: {key}={stated:g} but the image has {width} x {height} pixels; "
                "fl_x, fl_y, cx, cy, w, h must be those of the image files"
            )
    fx, fy = focal_lengths(frame.own, width, height, label)
    if fx is None and fy is None:
        fx, fy = focal_lengths(frame.shared, width, height, label)
    fx, fy = fx or fy, fy or fx
    if fx is None or fy is None:
        raise ValueError(f"{label} has no intrinsics: expected fl_x (pixels) or camera_angle_x (radians)")
    cx, cy = finite_number(merged, "cx", label), finite_number(merged, "cy", label)
    distortion = [finite_number(merged, key, label) or 0.0 for key in ("k1", "k2", "p1", "p2")]
    return [fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy, *distortion]


def load_scene(
    name: str,
    folder: Path,
    frames: Sequence[Frame],
    train: list[int],
    held_out: list[int],
    downscale: int,
    *,
    recentre: bool,
    bounds: tuple[float, float] | None = None,
) -> Scene:
    """Reads the images of the split and puts the scene together.

    Args:
        name: of the scene reader.
        frames: the world is normalised over all of them, used or not.
        train, held_out: indices into `frames`.
        downscale: integer factor by which images are reduced.
        recentre: orient and centre the world; else it is only scaled.
        bounds: near and far in the source's units.

    Raises:
        ValueError: an image is in both splits, a split is empty, or poses, images or intrinsics are not usable.
    """
    both = {frames[index].key for index in train} & {frames[index].key for index in held_out}
    if both:
        raise ValueError(f"{folder}: image {min(both)!r} is in the training and in the evaluation split")
    if not train or not held_out:
        raise ValueError(f"{folder}: the split leaves no image to {'evaluate' if train else 'train'}")
    try:
        poses, transform = normalise(np.stack([frame.pose for frame in frames]), orient=recentre, centre=recentre)
    except ValueError as error:
        raise ValueError(f"{folder}: {error}") from error
    used = sorted({*train, *held_out})
    train, held_out = [used.index(index) for index in train], [used.index(index) for index in held_out]
    frames = [frames[index] for index in used]
    files = [open_header(folder, frame.name, frame.file) for frame in frames if frame.file is not None]
    width, height = common_size(folder, files)
    check_downscale(f"scene={name}", downscale, width, height)
    table = np.array([intrinsics(frame, width, height, f"{folder}: frame {frame.name!r}") for frame in frames])
    check_lenses(folder, frames, table, width, height)
    images, contents = read_images(folder, files, downscale)
    sources = np.stack([frame.pose for frame in frames])
    fingerprint = digest(contents, sources, table, np.array(train), np.array(held_out), np.array([downscale]))
    table[:, :4] /= downscale
    scale = float(np.linalg.norm(transform[:3, 0]))
    near, far = (None, None) if bounds is None else (bounds[0] * scale, bounds[1] * scale)
    return Scene(
        name=name,
        images=torch.from_numpy(images),
        cameras=Cameras.from_arrays(poses[used], table, width // downscale, height // downscale),
        train=train,
        eval=held_out,
        names=[file.name for file in files],
        fingerprint=fingerprint,
        transform=torch.from_numpy(transform),
        near=near,
        far=far,
    )


def check_lenses(folder: Path, frames: Sequence[Frame], table: NDArray, width: int, height: int) -> None:
    """ValueError, naming the frame, if a lens distortion cannot be inverted everywhere in the image.

    Args:
        table: (V, 8) fx fy cx cy k1 k2 p1 p2.
    """
    x, y = np.meshgrid(np.linspace(0, width, 33), np.linspace(0, height, 33))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    unique, inverse = np.unique(table, axis=0, return_inverse=True)
    for row, lens in enumerate(unique):
        if not lens[4:].any():
            continue
        points = torch.from_numpy((pixels - lens[2:4]) / lens[:2])
        if not bool(invertible(points, torch.from_numpy(lens[4:])).all()):
            frame = frames[int(np.argmax(inverse.reshape(-1) == row))]
            values = " ".join(f"{key}={value:g}" for key, value in zip(("k1", "k2", "p1", "p2"), lens[4:], strict=True))
            raise ValueError(
                f"{folder}: frame {frame.name!r}: the lens distortion {values} folds the image over and cannot be "
                "undone; check these values, or undistort the images first"
            )
