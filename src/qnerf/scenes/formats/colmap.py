"""A COLMAP reconstruction: cameras, images and sparse points, binary or text, and the photographs."""

import math
import posixpath
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from qnerf.config.bounds import Count
from qnerf.scenes.base import SCENES, Scene
from qnerf.scenes.folders import FORMATS, SceneFolder, contents
from qnerf.scenes.intrinsics import CURE_MODEL
from qnerf.scenes.loading import Capture, PosedImage, load_scene

PLACES = ("sparse/0", "sparse", "colmap/sparse/0", ".")
"""Where a model lies in a scene's folder."""
ENDINGS = (".bin", ".txt")
FORMATS["colmap"] = tuple(f"{place}/images{ending}".removeprefix("./") for place in PLACES for ending in ENDINGS)

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
    width: Count | None = None,
    eval_every: Count | None = 8,
    skip_missing: bool = False,
    points: bool = False,
) -> Scene:
    """Reads a COLMAP model, such as `path`/sparse/0, and the photographs that it poses, in the order of their names.

    The world is oriented, centred and scaled over all views.

    Args:
        path: the folder.
        images: folder of the photographs inside `path`, such as images_4. Where it lacks one, `path` itself, images_2,
            images_4 and images_8 are searched. Smaller images than the model's are fine, and another suffix.
        model: folder of the model inside `path`; None: sparse/0, sparse, colmap/sparse/0, or `path` itself. The largest
            is read of sparse/0, sparse/1 and so on.
        width: that of images which are wider, in pixels; the area filter reduces them to it.
        eval_every: every so many views one is held out, the first view among them; None: 10 % of the views.
        skip_missing: leave out posed photographs that are missing.
        points: also read the sparse points, which the term `sparse_depth` of the loss takes.

    Raises:
        ValueError: one line that names the mistake and the file or photograph.
    """
    folder = SceneFolder(path)
    place, others = find_model(folder.path) if model is None else (folder.path / model, [])
    if place is None or model_ending(place) is None:
        where = f"no COLMAP model{contents(folder.path, FORMATS['colmap'])}" if model is None else f"none in {model}"
        raise ValueError(f"scene.path={str(path)!r} has {where}; expected cameras.bin and images.bin, or .txt")
    content = read_model(place)
    seen = read_points(place) if points else {}
    posed = [
        posed_image(folder, images, frame, np.array(seen.get(number, [])).reshape(-1, 3) if points else None)
        for number, frame in zip(content["numbers"], content["frames"], strict=True)
    ]
    posed.sort(key=lambda image: image.name)
    top = place.relative_to(folder.path).parts[:1] or tuple(file.name for file in place.glob("*.*"))
    capture = Capture("colmap", folder, place, posed, remarks=[*others, *content["remarks"]], read=top)
    return load_scene(capture, width, skip_missing=skip_missing, eval_every=eval_every)


def posed_image(folder: SceneFolder, images: str, frame: dict[str, Any], points: NDArray | None = None) -> PosedImage:
    """A frame of `read_model` with its photograph, in the folder `images`, in the scene's folder, or in images_2 ..."""
    own, named = frame["file_path"], f"{images}/{frame['file_path']}"
    file = folder.image(named)
    name = named if file or folder.image(own) is None else own
    file = file or folder.image(own) or folder.image(posixpath.splitext(named)[0]) or folder.smaller(named)
    return PosedImage(name, file, np.array(frame["transform_matrix"]), frame, points=points)


def model_ending(place: Path) -> str | None:
    """The ending of the files of the model in a folder; None if there is no model.

    A complete model goes before files that were left over from another one, as in COLMAP, which wants the points, too.
    """
    for files in (("cameras", "images", "points3D"), ("cameras", "images")):
        for ending in ENDINGS:
            if all((place / f"{file}{ending}").is_file() for file in files):
                return ending
    return None


def find_model(folder: Path) -> tuple[Path | None, list[str]]:
    """The folder of a COLMAP model, binary or text, inside a scene's folder, and a remark if it was chosen.

    COLMAP's mapper leaves sparse/0, sparse/1 and so on where it could not join all photographs. The model that poses
    most of them is taken.
    """
    for place in PLACES:
        numbered = sorted((folder / place).parent.glob("[0-9]*")) if place.endswith("0") else [folder / place]
        models = [one for one in numbered if model_ending(one)]
        if len(models) > 1:
            posed = {one.relative_to(folder).as_posix(): posed_count(one) for one in models}
            largest = max(posed, key=lambda name: posed[name])
            told = ", ".join(f"{name} poses {count}" for name, count in posed.items())
            return folder / largest, [f"of several models the largest is read: {told}"]
        if models:
            return models[0], []
    return None, []


def posed_count(place: Path) -> int:
    """How many images a COLMAP model poses; 0 if it cannot be read."""
    try:
        return len(read_model(place)["frames"])
    except ValueError:
        return 0


def read_model(place: Path) -> dict[str, Any]:
    """The posed images of a COLMAP model as the content of a transforms file; `file_path` is COLMAP's image name.

    `numbers` has COLMAP's number of each frame, `remarks` what was left out.

    Raises:
        ValueError: a file is damaged or missing, a camera model is not supported, or no image is posed.
    """
    ending = model_ending(place)
    cameras_file, images_file = place / f"cameras{ending}", place / f"images{ending}"
    remarks: list[str] = []
    with _damage_said(place):
        cameras = _unique(cameras_file, _cameras(cameras_file) if ending == ".bin" else _cameras_text(cameras_file))
        found = _images(images_file) if ending == ".bin" else _images_text(images_file, remarks)
        images = _unique(images_file, found)
    if not images:
        raise ValueError(f"{images_file}: no image is posed")
    frames = []
    for name, pose, camera in images.values():
        if camera not in cameras:
            raise ValueError(f"{images_file}: image {name!r} has camera {camera}, which {cameras_file.name} lacks")
        frames.append({"file_path": name, "transform_matrix": camera_to_world(*pose), **cameras[camera]})
    return {"frames": frames, "numbers": list(images), "remarks": remarks}


def read_points(place: Path) -> dict[int, list[Sequence[float]]]:
    """Number of an image -> the sparse points that it sees, x y z in the model's world.

    Raises:
        ValueError: the file is damaged or missing.
    """
    ending = model_ending(place)
    file = place / f"points3D{ending}"
    seen: dict[int, list[Sequence[float]]] = {}
    with _damage_said(place):
        for point, images in _points(file) if ending == ".bin" else _points_text(file):
            for image in images:
                seen.setdefault(image, []).append(point)
    return seen


@contextmanager
def _damage_said(place: Path) -> Iterator[None]:
    """Makes whatever a damaged or missing file of the model raises one line."""
    try:
        yield
    except OSError as error:
        raise ValueError(f"{error.filename} cannot be read: {error.strerror}") from error
    except (struct.error, ValueError, IndexError, TypeError, OverflowError) as error:
        if str(error).startswith(str(place)):
            raise
        raise ValueError(f"{place}: the COLMAP model is damaged or cut short") from error


def _unique(file: Path, entries: Iterator[tuple[int, Any]]) -> dict[int, Any]:
    """The entries by their numbers; ValueError if a number comes twice."""
    found: dict[int, Any] = {}
    for number, entry in entries:
        if number in found:
            raise ValueError(f"{file}: number {number} comes twice")
        found[number] = entry
    return found


def camera_to_world(qw: float, qx: float, qy: float, qz: float, tx: float, ty: float, tz: float) -> list[list[float]]:
    """COLMAP's pose -> camera-to-world 4 x 4, OpenGL's axes.

    COLMAP gives the rotation, as a quaternion, and the translation from the world to a camera with x to the right,
    y down and z forward. In plain floats, so that every machine finds the same numbers.

    >>> camera_to_world(1, 0, 0, 0, 1, 2, 3)
    [[1.0, 0.0, 0.0, -1.0], [0.0, -1.0, 0.0, -2.0], [0.0, 0.0, -1.0, -3.0], [0.0, 0.0, 0.0, 1.0]]
    """
    norm = math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
    if not 0 < norm < math.inf:
        raise ValueError(f"the COLMAP model has a pose with the quaternion {qw:g} {qx:g} {qy:g} {qz:g}: no rotation")
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


def _images(file: Path) -> Iterator[tuple[int, Posed]]:
    with file.open("rb") as stream:
        (count,) = _unpack(stream, "Q")
        for _ in range(count):
            number, *pose, camera = _unpack(stream, "i7di")
            name = bytearray()
            while (byte := _unpack(stream, "c")[0]) != b"\0":
                name += byte
                if len(name) > MAX_NAME:
                    raise IndexError
            (points,) = _unpack(stream, "Q")
            stream.seek(POINT_BYTES * points, 1)
            yield number, (name.decode(), tuple(pose), camera)


def _points(file: Path) -> Iterator[tuple[Sequence[float], Sequence[int]]]:
    """Each point, and the numbers of the images that see it."""
    with file.open("rb") as stream:
        (count,) = _unpack(stream, "Q")
        for _ in range(count):
            _, x, y, z, *_, length = _unpack(stream, "Q3d3BdQ")
            yield (x, y, z), _unpack(stream, "ii" * length)[::2]


def _points_text(file: Path) -> Iterator[tuple[Sequence[float], Sequence[int]]]:
    for line in _lines(file):
        if line and line[0] != "#":
            _, x, y, z, _, _, _, _, *track = line.split()
            yield (float(x), float(y), float(z)), [int(image) for image in track[::2]]


def _lines(file: Path) -> Iterator[str]:
    """The lines without white space around them."""
    return (line.strip() for line in file.read_text(encoding="utf-8").removesuffix("\n").split("\n"))


def _cameras_text(file: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    for line in _lines(file):
        if line and line[0] != "#":
            number, kind, width, height, *values = line.split()
            model, names = _model(file, kind)
            if len(values) != len(names.split()):
                raise IndexError
            yield int(number), keys_of(model, names, int(width), int(height), [float(value) for value in values])


def _images_text(file: Path, remarks: list[str]) -> Iterator[tuple[int, Posed]]:
    """Blank lines and comments may stand before an image, but the next line is always that of its points.

    Names may hold spaces, of which COLMAP itself reads the first word.
    """
    lines = _lines(file)
    for line in lines:
        if not line or line[0] == "#":
            continue
        fields = line.split(maxsplit=9)
        if len(fields) != 10:
            raise IndexError
        number, *pose, camera, name = fields
        points = next(lines, None)
        if points is None:  # COLMAP leaves such an image out
            remarks.append(f"{file.name} ends before the line of points of {name!r}, which is left out as in COLMAP")
            return
        _check_points(file, name, points)
        yield int(number), (name, tuple(float(value) for value in pose), int(camera))


def _check_points(file: Path, name: str, line: str) -> None:
    """ValueError unless a line may be that of an image's points: x y number x y number ..."""
    values = line.split()
    if not line.startswith("#") and (len(values) % 3 or not all(map(_is_number, values[:12]))):
        raise ValueError(
            f"{file}: image {name!r} must be followed by the line of its points, got {line[:40]!r}; where an image has "
            "none, write an empty line after it"
        )


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _model(file: Path, kind: int | str) -> tuple[str, str]:
    """Name and parameters of a camera model, from its number or name."""
    known = {key: entry for number, entry in MODELS.items() for key in (number, entry[0])}
    if kind not in known:
        names = ", ".join(name for name, _ in MODELS.values())
        raise ValueError(f"{file}: camera model {kind} is not supported; known: {names}; {CURE_MODEL}")
    return known[kind]
