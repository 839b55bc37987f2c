"""Photographs or a video -> a scene with poses: structure from motion by COLMAP, through its package pycolmap."""

import contextlib
import json
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import TimeoutError as Unfinished
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

from PIL import Image, ImageOps

from qnerf.scenes.base import MIN_VIEWS
from qnerf.scenes.colmap import read_model
from qnerf.scenes.folders import PHOTOGRAPHS, photographs
from qnerf.scenes.images import open_header
from qnerf.scenes.video import extract_frames

MIN_FEATURES = 40  # an image with fewer cannot be posed
MAX_SIDE = 1600  # pixels; larger images are reduced before features are searched
ENOUGH = 0.9  # share of the photographs that must have a pose, else more pairs are compared
POLL = 0.2  # seconds between looks at COLMAP's database
JPEG_QUALITY = 95
ORIENTATION = 0x0112  # EXIF
# For small or few photographs, where COLMAP's own limits leave no pair to begin with.
RELAXED = {"init_min_num_inliers": 30, "init_min_tri_angle": 4.0, "abs_pose_min_num_inliers": 15}

Progress = Callable[[str, int, int], None]
"""Receives what is being done, how much of it is done, and how much there is."""


@dataclass(frozen=True)
class Captured:
    """What became of the photographs."""

    posed: list[str]  # names
    others: list[str]  # of photographs without a pose
    groups: list[int]  # photographs in each group that shows nothing of the others; the first group is the scene
    error: float  # mean distance of features from their projected points, pixels


def capture(
    source: Path,
    out: Path,
    *,
    frames: int = 150,
    lens: Literal["auto", "shared", "each"] = "auto",
    order: Literal["auto", "any", "sequence"] = "auto",
    progress: Progress = lambda what, done, total: None,
) -> Captured:
    """Finds the poses of photographs, undoes lens distortion, and writes a folder that scene=nerfstudio reads.

    The folder appears when it is complete; until then everything is in a hidden folder beside it.

    Args:
        source: a folder of photographs, or a video.
        out: the scene's folder; it must not exist, or be empty.
        frames: taken from a video: the sharpest in each of so many parts of it.
        lens: shared: one camera and zoom took all photographs; each: every photograph has its own intrinsics; auto:
            shared if all have one size.
        order: sequence: a photograph is compared with its neighbours only, in the order of names; any: with all others;
            auto: for a video sequence, and any if that leaves more than a tenth without a pose; else any.

    Raises:
        ValueError: pycolmap is missing, `out` is not empty, or the photographs cannot be read or posed. Then nothing
            has been written.
    """
    sfm = _pycolmap()
    if os.path.lexists(out) and not (out.is_dir() and not any(out.iterdir())):
        raise ValueError(f"{out} exists already; choose a new folder")
    video = source.is_file() and source.suffix.lower() not in PHOTOGRAPHS
    if not video:
        _check_photographs(source)
    out.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    try:
        taken = work / "photographs"
        taken.mkdir()
        if video:
            extract_frames(source, taken, frames, progress)
        else:
            _collect(photographs(source), taken)
        names = [path.name for path in photographs(taken)]
        if len(names) < MIN_VIEWS:
            raise ValueError(f"{source}: expected at least {MIN_VIEWS} photographs, got {len(names)}")
        one_size = len({_size(taken / name) for name in names}) == 1
        shared = lens == "shared" or (lens == "auto" and one_size)
        matchings = {"sequence": ["sequential"], "any": ["exhaustive"]}.get(order, ["exhaustive"])
        if order == "auto" and video:
            matchings = ["sequential", "exhaustive"]
        with _quiet(sfm):
            models = _reconstruct(sfm, taken, names, work, shared, matchings, progress)
            captured = _report(models, names)
            progress("undistort", 0, 1)
            model = work / "model"
            model.mkdir()
            models[0].write(str(model))
            sfm.undistort_images(str(work / "scene"), str(model), str(taken), jpeg_quality=JPEG_QUALITY)
        scene = work / "written"
        scene.mkdir()
        os.replace(work / "scene" / "images", scene / "images")
        content = transforms(read_model(work / "scene" / "sparse"))
        (scene / "transforms.json").write_text(json.dumps(content, indent=1))
        scene.chmod(0o777 & ~_umask())
        if out.is_dir():
            out.rmdir()
        os.replace(scene, out)
        progress("undistort", 1, 1)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return captured


def transforms(content: dict[str, Any]) -> dict[str, Any]:
    """A transforms file from what `read_model` returns: names in `images`, sorted; keys that all frames share once."""
    frames = sorted(content["frames"], key=lambda frame: str(frame["file_path"]))
    own = {"file_path", "transform_matrix"}
    shared = {
        key: value
        for key, value in frames[0].items()
        if key not in own and all(frame.get(key) == value for frame in frames)
    }
    listed = [
        {key: value for key, value in frame.items() if key not in shared}
        | {"file_path": f"images/{frame['file_path']}"}
        for frame in frames
    ]
    return {**shared, "frames": listed}


def _pycolmap() -> Any:
    try:
        import pycolmap
    except ImportError as error:
        raise ValueError('pycolmap is not installed here: pip install "qnerf[capture]"') from error
    return pycolmap


def _check_photographs(source: Path) -> None:
    """ValueError unless `source` is a folder with enough photographs that can be read."""
    if not source.is_dir():
        raise ValueError(f"{source} {'is no video or folder' if source.exists() else 'does not exist'}")
    found = photographs(source)
    if len(found) < MIN_VIEWS:
        kinds = ", ".join(kind[1:] for kind in PHOTOGRAPHS)
        raise ValueError(f"{source}: expected a folder of at least {MIN_VIEWS} photographs ({kinds}), got {len(found)}")
    for path in found:
        open_header(source, path.name, path)


def _collect(found: list[Path], folder: Path) -> None:
    """Copies the photographs, upright: a camera that was held sideways says so in EXIF, which COLMAP ignores."""
    for path in found:
        try:
            with Image.open(path) as image:
                image.load()
                if image.getexif().get(ORIENTATION, 1) == 1:
                    shutil.copyfile(path, folder / path.name)
                    continue
                upright = ImageOps.exif_transpose(image)
                upright.save(folder / path.name, quality=JPEG_QUALITY, exif=upright.getexif())
        except (OSError, SyntaxError, ValueError) as error:
            raise ValueError(f"{path} does not decode: {error}") from error


def _size(path: Path) -> tuple[int, int]:
    with Image.open(path) as image:
        return image.size


def _extract(sfm: Any, folder: Path, names: list[str], database: Path, shared: bool, progress: Progress) -> None:
    """Finds the features of all photographs. ValueError if too few have any."""
    mode = sfm.CameraMode.SINGLE if shared else sfm.CameraMode.PER_IMAGE
    reading = sfm.ImageReaderOptions(camera_model="OPENCV" if shared else "SIMPLE_RADIAL")
    extraction = sfm.FeatureExtractionOptions(max_image_size=MAX_SIDE)
    options = {"camera_mode": mode, "reader_options": reading, "extraction_options": extraction}
    extract = partial(sfm.extract_features, str(database), str(folder), names, **options)
    _follow(extract, progress, "features", len(names), lambda: _count(database, "keypoints"))
    rich = _count(database, "keypoints", f"rows >= {MIN_FEATURES}")
    if rich < MIN_VIEWS:
        raise ValueError(
            f"{rich} of {len(names)} photographs have {MIN_FEATURES} features or more, {MIN_VIEWS} are needed: blank "
            "walls, blur and darkness show none"
        )


def _reconstruct(
    sfm: Any, folder: Path, names: list[str], work: Path, shared: bool, matchings: list[str], progress: Progress
) -> list[Any]:
    """COLMAP's reconstructions, the one with most photographs first; ValueError if there is none.

    matchings: "sequential" or "exhaustive". The next is tried where one leaves more than a tenth without a pose.
    """
    database = work / "database.db"
    _extract(sfm, folder, names, database, shared, progress)
    models: list[Any] = []
    for matching in matchings:
        _match(sfm, database, len(names), matching, progress)
        options: tuple[dict[str, float], ...] = ({}, RELAXED)
        found = (
            _map(sfm, folder, work / f"{matching}{len(each)}", database, len(names), each, progress) for each in options
        )
        models = next((some for some in found if some), models)
        if models and models[0].num_reg_images() >= ENOUGH * len(names):
            break
    if not models:
        raise ValueError(
            f"the poses of fewer than {MIN_VIEWS} of {len(names)} photographs can be found: they share too few "
            "features, or the camera only turned; walk around the scene, and let neighbours overlap by half or more"
        )
    return models


def _match(sfm: Any, database: Path, photographs: int, matching: str, progress: Progress) -> None:
    """Compares pairs of photographs. ValueError if none show the same things."""
    pairs = photographs * (photographs - 1) // 2
    if matching == "sequential":  # with those at distances of 2, 4, 8, ...
        pairs = min(pairs, 2 * photographs * sfm.SequentialPairingOptions().overlap)
    run = partial(getattr(sfm, f"match_{matching}"), str(database))
    _follow(run, progress, "matches", pairs, lambda: _count(database, "two_view_geometries"))
    if not _count(database, "two_view_geometries", "rows > 0"):
        raise ValueError("no two photographs show the same things: neighbours must overlap by half or more")


def _map(
    sfm: Any, folder: Path, place: Path, database: Path, total: int, options: dict[str, float], progress: Progress
) -> list[Any]:
    """Reconstructions of at least `MIN_VIEWS` photographs, the largest first."""
    pipeline = sfm.IncrementalPipelineOptions(min_model_size=MIN_VIEWS, random_seed=0)
    for key, value in options.items():
        setattr(pipeline.mapper, key, value)
    place.mkdir()
    placed: list[None] = []  # one for each photograph that COLMAP has posed
    callback = {"next_image_callback": lambda: placed.append(None)}
    run = partial(sfm.incremental_mapping, str(database), str(folder), str(place), options=pipeline, **callback)
    found = _follow(run, progress, "poses", total, lambda: len(placed))
    models = [model for model in found.values() if model.num_reg_images() >= MIN_VIEWS]
    return sorted(models, key=lambda model: -model.num_reg_images())


def _report(models: list[Any], names: list[str]) -> Captured:
    posed = {image.name for image in models[0].images.values() if image.has_pose}
    return Captured(
        posed=sorted(posed),
        others=[name for name in names if name not in posed],
        groups=[model.num_reg_images() for model in models],
        error=float(models[0].compute_mean_reprojection_error()),
    )


def _follow(call: Callable[[], Any], progress: Progress, what: str, total: int, done: Callable[[], int]) -> Any:
    """The result of `call`, which runs in a thread while `done` is reported."""
    progress(what, 0, total)
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(call)
        while True:
            try:
                result = running.result(timeout=POLL)
                break
            except Unfinished:
                pass
            except (RuntimeError, ValueError) as error:
                raise ValueError(f"COLMAP cannot go on: {str(error).splitlines()[0]}") from error
            progress(what, min(done(), total), total)
    progress(what, total, total)
    return result


def _count(database: Path, table: str, where: str = "1") -> int:
    """Rows of a table of COLMAP's database, which it may be writing; 0 if they cannot be read now."""
    try:
        with contextlib.closing(sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True)) as opened:
            return int(opened.execute(f"SELECT COUNT(*) FROM {table} WHERE {where}").fetchone()[0])
    except sqlite3.Error:
        return 0


@contextlib.contextmanager
def _quiet(sfm: Any) -> Iterator[None]:
    """COLMAP tells of every step on standard error; here only what ends the process."""
    before = sfm.logging.minloglevel
    sfm.logging.minloglevel = 3
    try:
        yield
    finally:
        sfm.logging.minloglevel = before


def _umask() -> int:
    current = os.umask(0)
    os.umask(current)
    return current
