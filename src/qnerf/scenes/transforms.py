"""Reads transforms.json as written by nerfstudio, instant-ngp and the synthetic-NeRF scenes."""

import json
import math
import posixpath
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from qnerf.config import memory
from qnerf.scenes.base import MIN_VIEWS, Cameras, Scene, digest
from qnerf.scenes.images import FileId, check_downscale, common_size, file_id, find_image, open_header, read_images
from qnerf.scenes.lens import invertible
from qnerf.scenes.normalise import MAX_ENTRY, normalise, rigid

FINGERPRINT = "2"  # raise it whenever `fingerprint` hashes something else
MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
UNSUPPORTED = ("k3", "k4", "k5", "k6")
SIZE = ("w", "h")
FOCAL = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")
CENTRE = ("cx", "cy")
DISTORTION = ("k1", "k2", "p1", "p2")
FOCAL_RANGE = (1e-3, 1e6)  # focal lengths, in longer sides of the image
MAX_OFFSET = 1e3  # of the principal point from the image's corner, in longer sides of the image
MAX_JSON_BYTES = 2**28
JSON_FACTOR = 8  # memory for a byte of a JSON file
READING_BYTES = 2**27  # for linear algebra: OpenBLAS ends the process if it gets no memory


@dataclass(frozen=True)
class Frame:
    """One frame of a transforms file."""

    name: str  # file_path as written
    file: Path | None  # the image; None: missing
    file_id: FileId | None  # equal for all names of one image file; None: missing
    matrix: NDArray  # (3, 4) float64, camera-to-world in the source's world, as written
    pose: NDArray  # (3, 4) float64, `matrix` with its rotation made orthonormal
    own: Mapping[str, Any]  # keys of this frame
    shared: Mapping[str, Any]  # keys of the whole file, overridden by the frame's

    @property
    def key(self) -> str:
        """Equal for all spellings of one path, whether or not the image exists."""
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
        size = file.stat().st_size
        if size <= MAX_JSON_BYTES:
            memory.require(f"{file}: reading it", READING_BYTES + JSON_FACTOR * size)
    except OSError as error:
        raise ValueError(f"{file} cannot be read: {error.strerror}") from error
    try:
        if size > MAX_JSON_BYTES:
            raise ValueError("more than 256 MiB")
        content = json.loads(file.read_bytes().decode("utf-8-sig"))
    except OSError as error:
        raise ValueError(f"{file} cannot be read: {error.strerror}") from error
    except MemoryError:
        raise ValueError(f"{file} does not fit into memory") from None
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
        ValueError: names the first frame with a missing or repeated file_path, with the image file of an earlier frame,
            or with a pose that is not rigid.
    """
    content = read_json(file)
    frames = []
    names: set[str] = set()
    images: dict[FileId, str] = {}
    for index, source in enumerate(content["frames"]):
        if not isinstance(source, dict):
            raise ValueError(f"{file}: frame {index} must be an object, got {type(source).__name__}")
        name = source.get("file_path")
        if not isinstance(name, str) or not name:
            raise ValueError(f"{file}: file_path of frame {index} must be a file name, got {_short(name)}")
        label = f"{file}: frame {name!r}"
        image = find_image(folder, name)
        matrix = read_matrix(source, label)
        frame = Frame(name, image, file_id(image) if image else None, matrix[:3], rigid(matrix, label), source, content)
        if frame.key in names:
            raise ValueError(f"{file} names image {name!r} twice")
        names.add(frame.key)
        if frame.file_id is not None and images.setdefault(frame.file_id, name) != name:
            raise ValueError(f"{file} names one image file twice: as {images[frame.file_id]!r} and as {name!r}")
        frames.append(frame)
    return frames


def read_matrix(source: Mapping[str, Any], label: str) -> NDArray:
    """A frame's transform_matrix as written, (3 or 4, 4) float64; ValueError unless it holds finite numbers."""
    if "transform_matrix" not in source:
        raise ValueError(f"{label} has no transform_matrix")
    rows = source["transform_matrix"]
    if not isinstance(rows, list) or not all(isinstance(row, list) for row in rows):
        raise ValueError(f"{label}: transform_matrix must be 4 x 4 numbers")
    if len(rows) not in (3, 4) or any(len(row) != 4 for row in rows):
        raise ValueError(f"{label}: transform_matrix must be 4 x 4 numbers, got rows of {[len(row) for row in rows]}")
    for value in (value for row in rows for value in row):
        if not is_number(value):
            wrong = f"NaN, infinity or beyond {MAX_ENTRY:g}"
            raise ValueError(f"{label}: transform_matrix must hold numbers, none {wrong}, got {_short(value)}")
    return np.array(rows, dtype=np.float64)


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


def is_number(value: Any) -> bool:
    """Whether a value of a JSON file is a finite number of at most `MAX_ENTRY`; text, true and false are none."""
    return type(value) in (int, float) and abs(value) <= MAX_ENTRY


def stated_numbers(keys: Mapping[str, Any], names: Sequence[str], label: str) -> dict[str, float]:
    """Those of `names` that `keys` has and that are not null. ValueError unless they are finite numbers."""
    stated = {name: keys[name] for name in names if keys.get(name) is not None}
    for name, value in stated.items():
        if not is_number(value):
            raise ValueError(f"{label}: {name} must be a finite number, got {_short(value)}")
    return {name: float(value) for name, value in stated.items()}


def stated_intrinsics(frame: Frame, label: str) -> dict[str, float]:
    """The numbers in the file that decide a frame's intrinsics, as written. Its own keys win over shared ones.

    Raises:
        ValueError: a number is not usable, the camera model is not supported, or there is no focal length.
    """
    merged = {**frame.shared, **frame.own}
    model = merged.get("camera_model")
    if (model is not None and model not in MODELS) or merged.get("is_fisheye"):
        name = "fisheye" if merged.get("is_fisheye") else _short(model)
        raise ValueError(f"{label}: camera model {name} is not supported; known: {', '.join(MODELS)}")
    for key, value in stated_numbers(merged, UNSUPPORTED, label).items():
        if value:
            raise ValueError(f"{label}: distortion {key}={value:g} is not supported; known: k1, k2, p1, p2")
    focal = stated_numbers(frame.own, FOCAL, label) or stated_numbers(frame.shared, FOCAL, label)
    if not focal:
        raise ValueError(f"{label} has no intrinsics: expected fl_x (pixels) or camera_angle_x (radians)")
    for axis in "xy":
        if f"fl_{axis}" in focal:
            focal.pop(f"camera_angle_{axis}", None)
    distortion = {key: value for key, value in stated_numbers(merged, DISTORTION, label).items() if value}
    return focal | stated_numbers(merged, (*SIZE, *CENTRE), label) | distortion


def focal_lengths(stated: Mapping[str, float], width: int, height: int, label: str) -> tuple[float, float]:
    """fx, fy in pixels, from fl_x, fl_y (pixels) or camera_angle_x, camera_angle_y (radians)."""
    low, high = (factor * max(width, height) for factor in FOCAL_RANGE)
    lengths: dict[str, float] = {}
    for axis, size in (("x", width), ("y", height)):
        length, angle = stated.get(f"fl_{axis}"), stated.get(f"camera_angle_{axis}")
        if length is None and angle is not None:
            if not 0 < angle < math.pi:
                raise ValueError(f"{label}: camera_angle_{axis} must be between 0 and pi, got {angle:g}")
            half = math.tan(0.5 * angle)
            length = 0.5 * size / half if half else math.inf
        if length is None:
            continue
        if length <= 0:
            raise ValueError(f"{label}: fl_{axis} must be above 0, got {length:g}")
        if not low <= length <= high:
            key = f"fl_{axis}" if f"fl_{axis}" in stated else f"camera_angle_{axis}"
            raise ValueError(
                f"{label}: {key}={stated[key]:g} is a focal length of {length:g} pixels; "
                f"expected {low:g} to {high:g} for an image of {width} x {height} pixels"
            )
        lengths[axis] = length
    one = next(iter(lengths.values()))
    return lengths.get("x", one), lengths.get("y", one)


def intrinsics(stated: Mapping[str, float], width: int, height: int, label: str) -> list[float]:
    """fx fy cx cy k1 k2 p1 p2 of a frame whose image has width x height pixels.

    stated: as from `stated_intrinsics`.
    """
    for key, size in (("w", width), ("h", height)):
        if stated.get(key, size) != size:
            raise ValueError(
                f"{label}: {key}={stated[key]:g} but the image has {width} x {height} pixels; "
                "fl_x, fl_y, cx, cy, w, h must be those of the image files"
            )
    limit = MAX_OFFSET * max(width, height)
    for key in CENTRE:
        if abs(stated.get(key, 0.0)) > limit:
            raise ValueError(
                f"{label}: {key} must be between {-limit:g} and {limit:g} for an image of {width} x {height} pixels, "
                f"got {stated[key]:g}"
            )
    centre = [stated.get("cx", width / 2), stated.get("cy", height / 2)]
    return [*focal_lengths(stated, width, height, label), *centre, *(stated.get(key, 0.0) for key in DISTORTION)]


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
    trained = {frames[index].file_id for index in train}
    both = [frames[index].key for index in held_out if frames[index].file_id in trained]
    if both:
        raise ValueError(f"{folder}: image {min(both)!r} is in the training and in the evaluation split")
    if not train or not held_out:
        raise ValueError(f"{folder}: the split leaves no image to {'evaluate' if train else 'train'}")
    try:
        poses, transform = normalise(np.stack([frame.pose for frame in frames]), orient=recentre, centre=recentre)
    except ValueError as error:
        raise ValueError(f"{folder}: {error}") from error
    matrices = [frame.matrix for frame in frames]
    used = sorted({*train, *held_out})
    train, held_out = [used.index(index) for index in train], [used.index(index) for index in held_out]
    frames = [frames[index] for index in used]
    files = [open_header(folder, frame.name, frame.file) for frame in frames if frame.file is not None]
    width, height = common_size(folder, files)
    check_downscale(f"scene={name}", downscale, width, height)
    labels = [f"{folder}: frame {frame.name!r}" for frame in frames]
    stated = [stated_intrinsics(frame, label) for frame, label in zip(frames, labels, strict=True)]
    table = np.array([intrinsics(numbers, width, height, label) for numbers, label in zip(stated, labels, strict=True)])
    check_lenses(folder, frames, table, width, height)
    images, hashes = read_images(folder, files, downscale)
    views = [
        {"frame": index, "image": file.name, "content": content, "lens": numbers}
        for index, file, content, numbers in zip(used, files, hashes, stated, strict=True)
    ]
    older = older_fingerprint(hashes, [frame.pose for frame in frames], table, train, held_out, downscale)
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
        fingerprint=fingerprint(name, matrices, views, train, held_out, downscale),
        older_fingerprint=older,
        transform=torch.from_numpy(transform),
        near=near,
        far=far,
    )


def fingerprint(
    name: str,
    matrices: Sequence[NDArray],
    views: Sequence[Mapping[str, Any]],
    train: Sequence[int],
    held_out: Sequence[int],
    downscale: int,
) -> str:
    """A hash of what the scene is read from. Nothing in it was computed, so every machine finds the same.

    Args:
        name: of the scene reader.
        matrices: (3, 4) as written, of all frames over which the world is normalised.
        views: of each view, its index into `matrices`, its image, the hash of the image file, and the numbers that
            decide its intrinsics, as written.
        train, held_out: indices into `views`.
    """
    content = {
        "reader": name,
        "matrices": [matrix.tolist() for matrix in matrices],
        "views": views,
        "train": train,
        "held_out": held_out,
        "downscale": downscale,
    }
    return digest("scene", FINGERPRINT, json.dumps(content, sort_keys=True, allow_nan=False))


def older_fingerprint(
    hashes: Sequence[str],
    poses: Sequence[NDArray],
    table: NDArray,
    train: Sequence[int],
    held_out: Sequence[int],
    downscale: int,
) -> str:
    """The fingerprint in the ids of older runs. Its last bits depend on the processor and on NumPy's version.

    Args:
        poses: (3, 4), their rotations made orthonormal.
        table: (V, 8) fx fy cx cy k1 k2 p1 p2 before `downscale`.
    """
    split = np.array(train), np.array(held_out), np.array([downscale])
    return digest(digest(*hashes), np.stack(poses), table, *split)


_short = reprlib.repr  # of what a file holds: never long, never deep


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
