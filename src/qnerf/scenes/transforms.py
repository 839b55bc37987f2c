"""transforms.json, as nerfstudio, instant-ngp and the synthetic-NeRF scenes write it."""

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

from qnerf.scenes.base import LEAST_VIEWS, Cameras, Scene, digest
from qnerf.scenes.images import check_downscale, inside, open_header, read_images, same_size
from qnerf.scenes.lens import invertible
from qnerf.scenes.normalise import rigid

MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
UNSUPPORTED = ("k3", "k4", "k5", "k6")
MOST_JSON_BYTES = 2**28


@dataclass(frozen=True)
class Frame:
    """One frame of a transforms file."""

    name: str  # file_path as written
    file: Path | None  # the image, where there is one
    pose: NDArray  # (3, 4) float64, camera-to-world in the source's world
    source: Mapping[str, Any]
    shared: Mapping[str, Any]  # the file's own keys, which frames may override

    @property
    def key(self) -> str:
        return posixpath.normpath(self.name)


def open_folder(path: str | Path) -> Path:
    """The scene's folder; ValueError where there is none."""
    folder = Path(path).expanduser()
    if not folder.is_dir():
        state = "is not a folder" if folder.exists() else "does not exist"
        raise ValueError(f"scene.path={str(path)!r} {state}; expected a folder with posed images")
    return folder


def read_json(file: Path) -> dict[str, Any]:
    """The file's object; ValueError where it is not JSON with a non-empty list of frames."""
    try:
        if file.stat().st_size > MOST_JSON_BYTES:
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
    """The frames of a transforms file in its order, those without an image included.

    Raises:
        ValueError: names the first frame that has no file_path, two of the same, or a pose that is not rigid.
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
        frame = Frame(name, inside(folder, name), rigid(pose, label), source, content)
        if frame.key in seen:
            raise ValueError(f"{file} names image {name!r} twice")
        seen.add(frame.key)
        frames.append(frame)
    return frames


def present(folder: Path, frames: Sequence[Frame], skip_missing: bool) -> list[Frame]:
    """The frames whose image exists.

    Raises:
        ValueError: images are missing and that was not asked for; fewer than three frames are left.
    """
    missing = [frame for frame in frames if frame.file is None]
    if missing and not skip_missing:
        raise ValueError(
            f"{folder}: {len(missing)} of {len(frames)} images are missing, the first is {missing[0].name!r}; "
            "scene.skip_missing=true goes on with the rest"
        )
    kept = [frame for frame in frames if frame.file is not None]
    if len(kept) < LEAST_VIEWS:
        without = f" ({len(missing)} of {len(frames)} are missing)" if missing else ""
        raise ValueError(f"{folder}: expected at least {LEAST_VIEWS} images, got {len(kept)}{without}")
    return kept


def number(source: Mapping[str, Any], key: str, label: str) -> float | None:
    """source[key] as a finite float, None where it is absent or null."""
    value = source.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= 1e12:
        raise ValueError(f"{label}: {key} must be a finite number, got {value!r}")
    return float(value)


def focal(source: Mapping[str, Any], width: int, height: int, label: str) -> tuple[float | None, float | None]:
    """Focal lengths in pixels from fl_x, fl_y or camera_angle_x, camera_angle_y (radians), None where neither is."""
    lengths: list[float | None] = []
    for axis, size in (("x", width), ("y", height)):
        length, angle = number(source, f"fl_{axis}", label), number(source, f"camera_angle_{axis}", label)
        if length is not None and length <= 0:
            raise ValueError(f"{label}: fl_{axis} must be above 0, got {length:g}")
        if length is None and angle is not None:
            if not 0 < angle < math.pi:
                raise ValueError(f"{label}: camera_angle_{axis} must be between 0 and pi, got {angle:g}")
            length = 0.5 * size / math.tan(0.5 * angle)
        lengths.append(length)
    return lengths[0], lengths[1]


def intrinsics(frame: Frame, width: int, height: int, label: str) -> list[float]:
    """fx fy cx cy k1 k2 p1 p2 of a frame whose image has width x height pixels; its own keys win over shared ones."""
    merged = {**frame.shared, **frame.source}
    model = merged.get("camera_model") or "OPENCV"
    if model not in MODELS or merged.get("is_fisheye"):
        name = "fisheye" if merged.get("is_fisheye") else repr(model)
        raise ValueError(f"{label}: camera model {name} is not supported; known: {', '.join(MODELS)}")
    for key in UNSUPPORTED:
        if number(merged, key, label):
            raise ValueError(f"{label}: distortion {key}={merged[key]:g} is not supported; known: k1, k2, p1, p2")
    for key, size in (("w", width), ("h", height)):
        stated = number(merged, key, label)
        if stated is not None and stated != size:
            raise ValueError(
                f"{label}: {key}={stated:g} but the image has {width} x {height} pixels; "
                "fl_x, fl_y, cx, cy, w, h must be those of the image files"
            )
    fx, fy = focal(frame.source, width, height, label)
    if fx is None and fy is None:
        fx, fy = focal(frame.shared, width, height, label)
    fx, fy = fx or fy, fy or fx
    if fx is None or fy is None:
        raise ValueError(f"{label} has no intrinsics: expected fl_x (pixels) or camera_angle_x (radians)")
    cx, cy = number(merged, "cx", label), number(merged, "cy", label)
    distortion = [number(merged, key, label) or 0.0 for key in ("k1", "k2", "p1", "p2")]
    return [fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy, *distortion]


def scene_from(
    name: str,
    folder: Path,
    frames: Sequence[Frame],
    train: list[int],
    held_out: list[int],
    poses: NDArray,
    transform: NDArray,
    downscale: int,
    bounds: tuple[float | None, float | None] = (None, None),
) -> Scene:
    """Reads the frames' images and puts the scene together; `poses` (V, 3, 4) are the frames' normalised ones."""
    files = []
    for frame in frames:
        assert frame.file is not None
        files.append(open_header(folder, frame.name, frame.file))
    width, height = same_size(folder, files)
    check_downscale(f"scene={name}", downscale, width, height)
    table = np.array([intrinsics(frame, width, height, f"{folder}: frame {frame.name!r}") for frame in frames])
    check_lenses(folder, frames, table, width, height)
    images, contents = read_images(folder, files, downscale)
    sources = np.stack([frame.pose for frame in frames])
    fingerprint = digest(contents, sources, table, np.array(train), np.array(held_out), np.array([downscale]))
    table[:, :4] /= downscale
    cameras = cameras_from(poses, table, width // downscale, height // downscale)
    return Scene(
        name=name,
        images=torch.from_numpy(images),
        cameras=cameras,
        train=train,
        eval=held_out,
        names=[file.name for file in files],
        fingerprint=fingerprint,
        transform=torch.from_numpy(transform),
        near=bounds[0],
        far=bounds[1],
    )


def cameras_from(poses: NDArray, table: NDArray, width: int, height: int) -> Cameras:
    """Poses (V, 3, 4) and fx fy cx cy k1 k2 p1 p2 (V, 8) as Cameras."""
    columns = torch.from_numpy(table.astype(np.float64))
    fx, fy, cx, cy = (column.clone() for column in columns[:, :4].unbind(1))
    return Cameras(torch.from_numpy(poses), fx, fy, cx, cy, columns[:, 4:].clone(), width, height)


def check_lenses(folder: Path, frames: Sequence[Frame], table: NDArray, width: int, height: int) -> None:
    """ValueError names the first frame whose distortion cannot be undone everywhere in the image."""
    x, y = np.meshgrid(np.linspace(0, width, 33), np.linspace(0, height, 33))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    unique, inverse = np.unique(table, axis=0, return_inverse=True)
    inverse = inverse.reshape(-1)
    for row, lens in enumerate(unique):
        if not lens[4:].any():
            continue
        points = torch.from_numpy((pixels - lens[2:4]) / lens[:2])
        if not bool(invertible(points, torch.from_numpy(lens[4:])).all()):
            frame = frames[int(np.argmax(inverse == row))]
            values = " ".join(f"{key}={value:g}" for key, value in zip(("k1", "k2", "p1", "p2"), lens[4:], strict=True))
            raise ValueError(
                f"{folder}: frame {frame.name!r}: the lens distortion {values} folds the image over and cannot be "
                "undone; check these values, or undistort the images first"
            )
