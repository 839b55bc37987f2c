"""A frame's intrinsics, from the numbers of a transforms file."""

import math
import reprlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from qnerf.scenes.lens import fisheye_invertible, invertible
from qnerf.scenes.normalise import MAX_ENTRY

PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
FISHEYE = ("OPENCV_FISHEYE",)
CURE = "undistort the images first, with `qnerf capture` or COLMAP's image_undistorter"
SIZE = ("w", "h")
FOCAL = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")
CENTRE = ("cx", "cy")
DISTORTION = ("k1", "k2", "p1", "p2")
FISHEYE_DISTORTION = ("k1", "k2", "k3", "k4")
FOCAL_RANGE = (1e-3, 1e6)  # focal lengths, in longer sides of the image
MAX_OFFSET = 1e3  # of the principal point from the image's corner, in longer sides of the image

_short = reprlib.repr  # of what a file holds: never long, never deep


def is_file_number(value: Any) -> bool:
    """Whether a value of a JSON file is a finite number of at most `MAX_ENTRY`; text, true and false are none."""
    return type(value) in (int, float) and abs(value) <= MAX_ENTRY


def stated_numbers(keys: Mapping[str, Any], names: Sequence[str], label: str) -> dict[str, float]:
    """Those of `names` that `keys` has and that are not null. ValueError unless they are finite numbers."""
    stated = {name: keys[name] for name in names if keys.get(name) is not None}
    for name, value in stated.items():
        if not is_file_number(value):
            raise ValueError(f"{label}: {name} must be a finite number, got {_short(value)}")
    return {name: float(value) for name, value in stated.items()}


def stated_intrinsics(own: Mapping[str, Any], shared: Mapping[str, Any], label: str) -> dict[str, float]:
    """The numbers that decide a frame's intrinsics, as written. Its own keys win over those of the whole file.

    A fisheye's have `fisheye`: 1 among them.

    Raises:
        ValueError: a number is not usable, the camera model is not supported, or there is no focal length.
    """
    merged = {**shared, **own}
    model = merged.get("camera_model")
    if model is not None and model not in (*PERSPECTIVE, *FISHEYE):
        known = ", ".join((*PERSPECTIVE, *FISHEYE))
        raise ValueError(f"{label}: camera model {_short(model)} is not supported; known: {known}; {CURE}")
    said = merged.get("is_fisheye")
    if said not in (None, False, True):
        raise ValueError(f"{label}: is_fisheye must be true or false, got {_short(said)}")
    fisheye = model in FISHEYE or bool(said)
    names, others = (FISHEYE_DISTORTION, DISTORTION[2:]) if fisheye else (DISTORTION, ("k3", "k4", "k5", "k6"))
    for key, value in stated_numbers(merged, others, label).items():
        if value:
            what = "of a fisheye " if fisheye else ""
            raise ValueError(
                f"{label}: distortion {key}={value:g} {what}is not supported; known: {', '.join(names)}; {CURE}"
            )
    focal = stated_numbers(own, FOCAL, label) or stated_numbers(shared, FOCAL, label)
    if not focal:
        raise ValueError(f"{label} has no intrinsics: expected fl_x (pixels) or camera_angle_x (radians)")
    for axis in "xy":
        if f"fl_{axis}" in focal:
            focal.pop(f"camera_angle_{axis}", None)
    if fisheye and not focal.keys() & {"fl_x", "fl_y"}:
        raise ValueError(f"{label}: a fisheye's focal length must be fl_x, in pixels")
    distortion = {key: value for key, value in stated_numbers(merged, names, label).items() if value}
    return ({"fisheye": 1.0} if fisheye else {}) | focal | stated_numbers(merged, (*SIZE, *CENTRE), label) | distortion


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
    """fx fy cx cy and the distortion of a frame whose image has width x height pixels: `Cameras.intrinsics`.

    stated: as from `stated_intrinsics`. If w and h are those of a larger image of the same shape, to the pixel, then
        the lengths in pixels are that image's and are scaled.
    """
    across, down = (
        size / stated.get(key, size) if stated.get(key) else 1 for key, size in (("w", width), ("h", height))
    )
    if max(across, down) < 1:
        off = max(abs(stated["w"] * down - width), abs(stated["h"] * across - height))
        if off < 1:
            factors = {"fl_x": across, "cx": across, "fl_y": down, "cy": down, "w": across, "h": down}
            stated = {key: value * factors.get(key, 1) for key, value in stated.items()}
            stated |= {"w": width, "h": height}
    for key, size in (("w", width), ("h", height)):
        if stated.get(key, size) != size:
            raise ValueError(
                f"{label}: {key}={stated[key]:g} but the image has {width} x {height} pixels; fl_x, fl_y, cx, cy, w, h "
                "must be those of the image files, or of larger images of the same shape"
            )
    limit = MAX_OFFSET * max(width, height)
    for key in CENTRE:
        if abs(stated.get(key, 0.0)) > limit:
            raise ValueError(
                f"{label}: {key} must be between {-limit:g} and {limit:g} for an image of {width} x {height} pixels, "
                f"got {stated[key]:g}"
            )
    centre = [stated.get("cx", width / 2), stated.get("cy", height / 2)]
    return [
        *focal_lengths(stated, width, height, label),
        *centre,
        *(stated.get(key, 0.0) for key in (FISHEYE_DISTORTION if "fisheye" in stated else DISTORTION)),
    ]


def check_lenses(labels: Sequence[str], table: NDArray, sizes: NDArray, fisheye: NDArray[np.bool_]) -> None:
    """ValueError, naming the frame, if a lens distortion cannot be inverted everywhere in the image.

    Args:
        labels: of the frames, for messages.
        table: (V, 8) fx fy cx cy and the distortion.
        sizes: (V, 2) width and height.
        fisheye: (V,).
    """
    kinds = np.concatenate([table, sizes, fisheye[:, None]], axis=1)
    unique, first = np.unique(kinds, axis=0, return_index=True)
    for lens, frame in zip(unique, first, strict=True):
        if not lens[4:8].any() and not lens[10]:
            continue
        x, y = np.meshgrid(np.linspace(0, lens[8], 33), np.linspace(0, lens[9], 33))
        points = torch.from_numpy((np.stack([x.ravel(), y.ravel()], axis=1) - lens[2:4]) / lens[:2])
        good = fisheye_invertible if lens[10] else invertible
        if not bool(good(points, torch.from_numpy(lens[4:8])).all()):
            names = FISHEYE_DISTORTION if lens[10] else DISTORTION
            values = " ".join(f"{key}={value:g}" for key, value in zip(names, lens[4:8], strict=True))
            raise ValueError(
                f"{labels[frame]}: the lens distortion {values} folds the image over and cannot be undone; "
                "check these values, or undistort the images first"
            )
