"""Photographs or a video -> a scene with poses: structure from motion by COLMAP, through its package pycolmap."""

import contextlib
import importlib.util
import json
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures import TimeoutError as Unfinished
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from multiprocessing import active_children, get_context
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Interval
from PIL import Image, ImageOps

from qnerf.capture import steps
from qnerf.capture.steps import Model
from qnerf.capture.video import extract_frames
from qnerf.config import bounds
from qnerf.scenes.base import MIN_VIEWS
from qnerf.scenes.folders import PHOTOGRAPHS, photographs
from qnerf.scenes.formats.colmap import read_model
from qnerf.scenes.images import open_header

MIN_FEATURES = 40  # an image with fewer cannot be posed
ENOUGH = 0.9  # share of the photographs that must have a pose, else more pairs are compared
POLL = 0.2  # seconds between looks at COLMAP's database
JPEG_QUALITY = 95
ORIENTATION = 0x0112  # EXIF
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
        ValueError: pycolmap is missing, `out` is not empty, or the photographs cannot be read or posed. In these cases
            nothing has been written.
    """
    if importlib.util.find_spec("pycolmap") is None:
        raise ValueError('pycolmap is not installed here: pip install "qnerf[capture]"')
    if os.path.lexists(out) and not (out.is_dir() and not any(out.iterdir())):
        raise ValueError(f"{out} exists already; choose a new folder")
    bounds.check("frames", frames, Annotated[int, Interval(ge=MIN_VIEWS, le=10**6)])
    video = source.is_file() and source.suffix.lower() not in PHOTOGRAPHS
    if not video:
        _check_photographs(source)
    work = _beside(out)
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
        matchings = {"sequence": ["sequential"], "auto": ["sequential", "exhaustive"] if video else ["exhaustive"]}
        models = _solve(taken, names, work, shared, matchings.get(order, ["exhaustive"]), progress)
        posed = set(models[0].posed)
        scene = _write(work / "scene", work / "written")
        if out.is_dir():
            out.rmdir()
        os.replace(scene, out)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return Captured(
        posed=sorted(posed),
        others=[name for name in names if name not in posed],
        groups=[len(model.posed) for model in models],
        error=models[0].error,
    )


def _solve(
    folder: Path,
    names: list[str],
    work: Path,
    shared: bool,
    matchings: list[str],
    progress: Progress,
) -> list[Model]:
    """COLMAP's models, see `_reconstruct`; the photographs of the first are written to `work`/scene, undistorted.

    In another process, because COLMAP ends its own where it fails, and because a second copy of SQLite must not read a
    database in the process that writes it.
    """
    others = active_children()
    with ProcessPoolExecutor(1, get_context("spawn"), steps.begin, (work / "log.txt",)) as colmap:
        try:
            models = _reconstruct(colmap, folder, names, work, shared, matchings, progress)
            running = colmap.submit(steps.undistort, models[0].folder, folder, work / "scene", JPEG_QUALITY)
            _follow(running, progress, "undistort", len(models[0].posed), lambda: _files(work / "scene" / "images"))
            return models
        except KeyboardInterrupt:  # of SIGTERM, say, which COLMAP's process does not get
            for process in active_children():
                if process not in others:
                    process.kill()
            raise


def _beside(out: Path) -> Path:
    """A new hidden folder beside `out`, so that the finished scene can be moved there at once."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        return Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    except OSError as error:
        raise ValueError(f"{out} cannot be made: {error.strerror}: {error.filename}") from error


def _write(undistorted: Path, scene: Path) -> Path:
    """Moves what `steps.undistort` wrote to the folder `scene`, and writes transforms.json beside it."""
    scene.mkdir()
    for part in ("images", "sparse"):
        os.replace(undistorted / part, scene / part)
    content = transforms(read_model(scene / "sparse"))
    (scene / "transforms.json").write_text(json.dumps(content, indent=1))
    return scene


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


def _check_photographs(source: Path) -> None:
    """ValueError unless `source` is a folder with enough photographs that can be read."""
    if not source.is_dir():
        raise ValueError(f"{source} {'is no video or folder' if source.exists() else 'does not exist'}")
    found = photographs(source)
    if len(found) < MIN_VIEWS:
        kinds = ", ".join(kind[1:] for kind in PHOTOGRAPHS)
        raise ValueError(f"{source}: expected a folder of at least {MIN_VIEWS} photographs ({kinds}), got {len(found)}")
    for path in found:
        open_header(source, path)


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


def _files(folder: Path) -> int:
    return sum(1 for _ in folder.iterdir()) if folder.is_dir() else 0


def _size(path: Path) -> tuple[int, int]:
    with Image.open(path) as image:
        return image.size


def _reconstruct(
    colmap: ProcessPoolExecutor,
    folder: Path,
    names: list[str],
    work: Path,
    shared: bool,
    matchings: list[str],
    progress: Progress,
) -> list[Model]:
    """COLMAP's models, the one with most photographs first; ValueError if there is none.

    matchings: "sequential" or "exhaustive". The next is tried where one leaves more than a tenth without a pose.
    """
    database, total = work / "database.db", len(names)
    running = colmap.submit(steps.extract, database, folder, names, shared)
    _follow(running, progress, "features", total, lambda: _count(database, "keypoints"))
    rich = _count(database, "keypoints", f"rows >= {MIN_FEATURES}")
    if rich < MIN_VIEWS:
        raise ValueError(
            f"{rich} of {total} photographs have {MIN_FEATURES} features or more, {MIN_VIEWS} are needed: blank walls, "
            "blur and darkness show none"
        )
    models: list[Model] = []
    for matching in matchings:
        pairs = total * (total - 1) // 2
        if matching == "sequential":
            pairs = min(pairs, total * steps.NEIGHBOURS)
        compared = colmap.submit(steps.match, database, matching)
        _follow(compared, progress, "matches", pairs, lambda: _count(database, "two_view_geometries"))
        if not _count(database, "two_view_geometries", "rows > 0"):
            raise ValueError("no two photographs show the same things: neighbours must overlap by half or more")
        if not shared and not _count(database, "two_view_geometries", f"rows > 0 AND config NOT IN {steps.FLAT}"):
            raise ValueError(
                "the camera only turned, or the scene is flat: poses cannot be found if each photograph may have its "
                "own lens; walk around the scene, or take all with one lens and size (--lens shared)"
            )
        for relaxed in (False, True):
            place = work / f"{matching}-{relaxed}"
            place.mkdir()
            mapped = colmap.submit(steps.reconstruct, database, folder, place, MIN_VIEWS, relaxed)
            found = _follow(mapped, progress, "poses", total, partial(steps.placed, place))
            if found:
                models = found
                break
        if models and len(models[0].posed) >= ENOUGH * total:
            break
    if not models:
        raise ValueError(
            f"the poses of fewer than {MIN_VIEWS} of {total} photographs can be found: they share too few features, or "
            "the camera only turned; walk around the scene, and let neighbours overlap by half or more"
        )
    return models


def _follow(running: Future[Any], progress: Progress, what: str, total: int, done: Callable[[], int]) -> Any:
    """The result of a step; `done` is reported until it is there. ValueError if COLMAP fails."""
    progress(what, 0, total)
    while True:
        try:
            result = running.result(timeout=POLL)
            break
        except Unfinished:
            progress(what, min(done(), total), total)
        except BrokenProcessPool as error:
            raise ValueError(f"COLMAP crashed while it was at {what}; are there enough memory and disk?") from error
        except (RuntimeError, ValueError, ImportError) as error:
            raise ValueError(f"COLMAP cannot go on: {str(error).splitlines()[0]}") from error
    progress(what, total, total)
    return result


def _count(database: Path, table: str, where: str = "1") -> int:
    """Rows of a table of COLMAP's database, which it may be writing; 0 if they cannot be read now."""
    try:
        with contextlib.closing(sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True)) as opened:
            return int(opened.execute(f"SELECT COUNT(*) FROM {table} WHERE {where}").fetchone()[0])
    except sqlite3.Error:
        return 0
