"""A COLMAP reconstruction: cameras and images, binary or text, and the photographs."""

import math
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from qnerf.config.bounds import Count
from qnerf.scenes.base import SCENES, Scene, split_views
from qnerf.scenes.folders import contents, find_model, scene_folder
from qnerf.scenes.images import find_image
from qnerf.scenes.intrinsics import CURE
from qnerf.scenes.loading import load_scene
from qnerf.scenes.transforms import frames_of, with_images

# COLMAP's number of each camera model, its name, and its parameters under the names of a transforms file.
MODELS: dict[int, tuple[str, str]] = {
    0: ("SIMPLE_PINHOLE", "fl_x cx cy"),
    1: ("PINHOLE", "fl_x fl_y cx cy"),
    2: ("SIMPLE_RADIAL", "fl_x cx cy k1"),
    3: ("RADIAL", "fl_x cx cy k1 k2"),
    4: ("OPENCV", "fl_x fl_y cx cy k1 k2 p1 p2"),
    5: ("OPENCV_FISHEYE", "fl_x fl_y cx cy k1 k2 k3 k4"),
    6: ("FULL_OPENCV", "fl_x fl_y cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    8: ("SIMPLE_RADIAL_FISHEYE", "fl_x cx cy k1"),
    9: ("RADIAL_FISHEYE", "fl_x cx cy k1 k2"),
    14: ("SIMPLE_FISHEYE", "fl_x cx cy"),
    15: ("FISHEYE", "fl_x fl_y cx cy"),
}
POINT_BYTES = 24  # x, y and the number of the 3D point, of each feature of an image
MAX_NAME = 4096  # bytes


@SCENES.register("colmap")
def colmap(
    *,
    path: str | Path,
    images: str = "images",
    model: str | None = None,
    downscale: Count = 1,
    width: Count | None = None,
    eval_every: Count | None = 8,
    skip_missing: bool = False,
) -> Scene:
    """Reads a COLMAP model, such as `path`/sparse/0, and the photographs that it poses, in the order of their names.

    The world is oriented, centred and scaled over all views.

    Args:
        path: the folder.
        images: folder of the photographs inside `path`, such as images_4. Where it lacks one, `path` itself, images_2,
            images_4 and images_8 are searched. Smaller images than the model's are fine.
        model: folder of the model inside `path`; None: sparse/0, sparse, colmap/sparse/0, or `path` itself.
        downscale: integer factor by which images are reduced, with an area filter.
        width: that of images which are wider, in pixels; the area filter reduces them to it.
        eval_every: every so many views one is held out, the first view among them; None: 10 % of the views.
        skip_missing: leave out posed photographs that are missing.

    Raises:
        ValueError: one line that names the mistake and the file or photograph.
    """
    folder = scene_folder(path)
    place = find_model(folder) if model is None else folder / model
    if place is None or not any((place / f"cameras{ending}").is_file() for ending in (".bin", ".txt")):
        where = f"no COLMAP model{contents(folder)}" if place is None else f"no COLMAP model in {model}"
        raise ValueError(f"scene.path={str(path)!r} has {where}; expected cameras.bin and images.bin, or .txt")
    content = read_model(place)
    for frame in content["frames"]:
        name = frame["file_path"]
        there = find_image(folder, f"{images}/{name}") is None and find_image(folder, name) is not None
        frame["file_path"] = name if there else f"{images}/{name}"
    frames = sorted(with_images(folder, frames_of(folder, place, content), skip_missing), key=lambda frame: frame.name)
    train, held_out = split_views(len(frames), eval_every)
    return load_scene("colmap", folder, frames, train, held_out, downscale, width, recentre=True)


def read_model(place: Path) -> dict[str, Any]:
    """The posed images of a COLMAP model as the content of a transforms file; `file_path` is COLMAP's image name.

    Raises:
        ValueError: a file is damaged or missing, a camera model is not supported, or no image is posed.
    """
    ending = ".bin" if (place / "cameras.bin").is_file() else ".txt"
    cameras_file, images_file = place / f"cameras{ending}", place / f"images{ending}"
    try:
        cameras = dict(_cameras(cameras_file) if ending == ".bin" else _cameras_text(cameras_file))
        images = list(_images(images_file) if ending == ".bin" else _images_text(images_file))
    except OSError as error:
        raise ValueError(f"{error.filename} cannot be read: {error.strerror}") from error
    except (struct.error, ValueError, IndexError, TypeError, OverflowError) as error:
        if str(error).startswith(str(cameras_file)):
            raise
        raise ValueError(f"{place}: the COLMAP model is damaged or cut short") from error
    if not images:
        raise ValueError(f"{images_file}: no image is posed")
    frames = []
    for name, pose, camera in images:
        if camera not in cameras:
            raise ValueError(f"{images_file}: image {name!r} has camera {camera}, which {cameras_file.name} lacks")
        frames.append({"file_path": name, "transform_matrix": camera_to_world(*pose), **cameras[camera]})
    return {"frames": frames}


def camera_to_world(qw: float, qx: float, qy: float, qz: float, tx: float, ty: float, tz: float) -> list[list[float]]:
    """COLMAP's pose -> camera-to-world 4 x 4, OpenGL's axes.

    COLMAP gives the rotation, as a quaternion, and the translation from the world to a camera with x to the right,
    y down and z forward. In plain floats, so that every machine finds the same numbers.

    >>> camera_to_world(1, 0, 0, 0, 1, 2, 3)
    [[1.0, 0.0, 0.0, -1.0], [0.0, -1.0, 0.0, -2.0], [0.0, 0.0, -1.0, -3.0], [0.0, 0.0, 0.0, 1.0]]
    """
    norm = math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
    if not 0 < norm < math.inf:
        raise ValueError(f"a pose with the quaternion {qw:g} {qx:g} {qy:g} {qz:g}, which is no rotation")
    w, x, y, z = (value / norm for value in (qw, qx, qy, qz))
    turn = (  # world to camera
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    rows = []
    for right, down, forward in zip(*turn, strict=True):
        rows.append([right, 0.0 - down, 0.0 - forward, 0.0 - (right * tx + down * ty + forward * tz)])
    return [*rows, [0.0, 0.0, 0.0, 1.0]]


def keys_of(model: str, names: str, width: int, height: int, values: Sequence[float]) -> dict[str, Any]:
    """A camera under the names of a transforms file."""
    lens = dict(zip(names.split(), values, strict=True))
    model = "OPENCV_FISHEYE" if model.endswith("FISHEYE") else "OPENCV" if model == "FULL_OPENCV" else model
    return {"camera_model": model, "w": width, "h": height, **lens}


Posed = tuple[str, tuple[float, ...], int]
"""Name, quaternion and translation, number of the camera."""


def _unpack(stream: BinaryIO, layout: str) -> tuple[Any, ...]:
    return struct.unpack(f"<{layout}", stream.read(struct.calcsize(f"<{layout}")))


def _cameras(file: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    with file.open("rb") as stream:
        (count,) = _unpack(stream, "Q")
        for _ in range(count):
            number, kind, width, height = _unpack(stream, "iiQQ")
            model, names = _model(file, kind)
            values = _unpack(stream, "d" * len(names.split()))
            yield number, keys_of(model, names, width, height, values)


def _images(file: Path) -> Iterator[Posed]:
    with file.open("rb") as stream:
        (count,) = _unpack(stream, "Q")
        for _ in range(count):
            _, *pose, camera = _unpack(stream, "i7di")
            name = bytearray()
            while (byte := _unpack(stream, "c")[0]) != b"\0":
                name += byte
                if len(name) > MAX_NAME:
                    raise IndexError
            (points,) = _unpack(stream, "Q")
            stream.seek(POINT_BYTES * points, 1)
            yield name.decode(), tuple(pose), camera


def _lines(file: Path) -> list[str]:
    return [line for line in file.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]


def _cameras_text(file: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    for line in _lines(file):
        if line.strip():
            number, kind, width, height, *values = line.split()
            model, names = _model(file, kind)
            if len(values) != len(names.split()):
                raise IndexError
            yield int(number), keys_of(model, names, int(width), int(height), [float(value) for value in values])


def _images_text(file: Path) -> Iterator[Posed]:
    for line in _lines(file)[::2]:  # each is followed by one with the image's features, which may be empty
        if line.strip():
            _, *pose, camera, name = line.split(maxsplit=9)
            yield name, tuple(float(value) for value in pose), int(camera)


def _model(file: Path, kind: int | str) -> tuple[str, str]:
    """Name and parameters of a camera model, from its number or name."""
    known = {key: entry for number, entry in MODELS.items() for key in (number, entry[0])}
    if kind not in known:
        names = ", ".join(name for name, _ in MODELS.values())
        raise ValueError(f"{file}: camera model {kind} is not supported; known: {names}; {CURE}")
    return known[kind]
