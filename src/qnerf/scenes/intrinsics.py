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
CURE_MODEL = f"{CURE}; cut panoramas into pinhole images"
SIZE = ("w", "h")
FOCAL = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")
CENTRE = ("cx", "cy")
DISTORTION = ("k1", "k2", "p1", "p2")
FISHEYE_DISTORTION = ("k1", "k2", "k3", "k4")
CROP = "fisheye_crop_radius"  # nerfstudio's: pixels farther from the middle of the image do not count
LENS = ("camera_model", "is_fisheye", *SIZE, *FOCAL, *CENTRE, *DISTORTION, "k3", "k4", "k5", "k6", CROP)
"""Keys of a frame, or of a whole transforms file, that decide its intrinsics."""
FIELD_OF_VIEW = (2.0, 170.0)  # degrees, along the longer side of the image
UNITS = "fl_x and fl_y are in pixels of images of w x h pixels, camera_angle_x and camera_angle_y in radians"
MAX_OFFSET = 1e3  # of the principal point from the image's corner, in longer sides of the image

_short = reprlib.repr  # of what a file holds: never long, never deep


def is_file_number(value: Any) -> bool:
    """Whether a value of a JSON file is a finite number of at most `MAX_ENTRY`. True and false are not numbers here."""
    return type(value) in (int, float) and abs(value) <= MAX_ENTRY


def stated_numbers(keys: Mapping[str, Any], names: Sequence[str], label: str) -> dict[str, float]:
    """Those of `names` that `keys` has and that are not null. ValueError unless they are finite numbers."""
    stated = {name: keys[name] for name in names if keys.get(name) is not None}
    for name, value in stated.items():
        if not is_file_number(value):
            raise ValueError(f"{label}: {name} must be a finite number, got {_short(value)}")
    return {name: float(value) for name, value in stated.items()}


def stated_intrinsics(lens: Mapping[str, Any], label: str) -> dict[str, float]:
    """The numbers that decide a frame's intrinsics, as written under the keys `LENS`.

    A fisheye's have `fisheye`: 1 among them.

    Raises:
        ValueError: a number is not usable, the camera model is not supported, or there is no focal length.
    """
    model = lens.get("camera_model")
    if model is not None and model not in (*PERSPECTIVE, *FISHEYE):
        known = ", ".join((*PERSPECTIVE, *FISHEYE))
        raise ValueError(f"{label}: camera model {_short(model)} is not supported; known: {known}; {CURE_MODEL}")
    said = lens.get("is_fisheye")
    if said not in (None, False, True):
        raise ValueError(f"{label}: is_fisheye must be true or false, got {_short(said)}")
    fisheye = model in FISHEYE or bool(said)
    names, unknown = (FISHEYE_DISTORTION, DISTORTION[2:]) if fisheye else (DISTORTION, ("k3", "k4", "k5", "k6"))
    for key, value in stated_numbers(lens, unknown, label).items():
        if value:
            what = "of a fisheye " if fisheye else ""
            raise ValueError(
                f"{label}: distortion {key}={value:g} {what}is not supported; known: {', '.join(names)}; {CURE}"
            )
    focal = stated_numbers(lens, FOCAL, label)
    if not focal:
        raise ValueError(f"{label} has no intrinsics: expected fl_x (pixels), camera_angle_x (radians) or K")
    for axis in "xy":
        if f"fl_{axis}" in focal:
            focal.pop(f"camera_angle_{axis}", None)
    if fisheye and not focal.keys() & {"fl_x", "fl_y"}:
        raise ValueError(f"{label}: a fisheye's focal length must be fl_x, in pixels")
    distortion = {key: value for key, value in stated_numbers(lens, names, label).items() if value}
    others = stated_numbers(lens, (*SIZE, *CENTRE, CROP), label)
    if others.get(CROP, 1) <= 0:
        raise ValueError(f"{label}: {CROP} must be above 0 pixels, got {others[CROP]:g}")
    return ({"fisheye": 1.0} if fisheye else {}) | focal | others | distortion


def focal_lengths(stated: Mapping[str, float], width: int, height: int) -> dict[str, float]:
    """Those that are stated, fx under `x` and fy under `y`, in pixels: fl_x, fl_y (pixels), else camera_angle_x,
    camera_angle_y (radians)."""
    lengths = {axis: stated[f"fl_{axis}"] for axis in "xy" if f"fl_{axis}" in stated}
    for axis, size in (("x", width), ("y", height)):
        if axis not in lengths and f"camera_angle_{axis}" in stated:
            lengths[axis] = 0.5 * size / max(math.tan(0.5 * stated[f"camera_angle_{axis}"]), 1e-300)
    return lengths


def check_focal_lengths(stated: Mapping[str, float], width: int, height: int, label: str) -> None:
    """ValueError if a focal length gives a field of view that no camera has.

    width, height: of the image that the focal lengths are stated for.
    """
    for axis in "xy":
        length, angle = stated.get(f"fl_{axis}"), stated.get(f"camera_angle_{axis}")
        if length is not None and length <= 0:
            raise ValueError(f"{label}: fl_{axis} must be above 0, got {length:g}")
        if length is None and angle is not None and not 0 < angle < math.pi:
            raise ValueError(f"{label}: camera_angle_{axis} must be between 0 and pi, got {angle:g}; {UNITS}")
    side = max(width, height)
    low, high = FIELD_OF_VIEW
    for axis, length in focal_lengths(stated, width, height).items():
        view = math.degrees(side / length) if "fisheye" in stated else field_of_view(length, side)
        if not low <= view <= (360.0 if "fisheye" in stated else high):
            key = f"fl_{axis}" if f"fl_{axis}" in stated else f"camera_angle_{axis}"
            raise ValueError(
                f"{label}: {key}={stated[key]:g} is a field of view of {view:.3g} degrees for an image of {width} x "
                f"{height} pixels; expected {low:g} to {high:g}; {UNITS}"
            )


def field_of_view(length: float, side: float) -> float:
    """Degrees across `side` pixels at a focal length in pixels."""
    return math.degrees(2 * math.atan2(side, 2 * length))


def intrinsics(stated: Mapping[str, float], width: int, height: int, label: str) -> list[float]:
    """fx fy cx cy and the distortion of a frame whose image has width x height pixels: `Cameras.intrinsics`.

    stated: as from `stated_intrinsics`. If w and h are those of a larger image of the same shape, to the pixel, then
        the lengths in pixels are that image's and are scaled.
    """
    across, down = (
        size / stated.get(key, size) if stated.get(key) else 1 for key, size in (("w", width), ("h", height))
    )
    larger = max(across, down) < 1 and max(abs(stated["w"] * down - width), abs(stated["h"] * across - height)) < 1
    full = (round(stated["w"]), round(stated["h"])) if larger else (width, height)
    check_focal_lengths(stated, *full, label)
    if larger:
        factors = {"fl_x": across, "cx": across, "fl_y": down, "cy": down}
        stated = {key: value * factors.get(key, 1) for key, value in stated.items()} | {"w": width, "h": height}
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
    lengths = focal_lengths(stated, width, height)
    one = next(iter(lengths.values()))
    return [
        *(lengths.get(axis, one) for axis in "xy"),
        stated.get("cx", width / 2),
        stated.get("cy", height / 2),
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
