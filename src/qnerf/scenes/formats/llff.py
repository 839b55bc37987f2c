"""An LLFF folder: poses_bounds.npy and images (arXiv:1905.00889)."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qnerf.config.bounds import Count
from qnerf.scenes.base import SCENES, Scene
from qnerf.scenes.folders import FORMATS, SMALLER, SceneFolder, contents, photographs
from qnerf.scenes.formats.colmap import find_model, read_model
from qnerf.scenes.loading import Capture, PosedImage, load_scene

FILE = "poses_bounds.npy"
FORMATS["llff"] = (FILE,)
SAME_LENS = 0.01  # relative difference of focal lengths up to which a COLMAP model is that of the poses


@SCENES.register("llff")
def llff(
    *,
    path: str | Path,
    images: str = "images",
    width: Count | None = None,
    eval_every: Count | None = 8,
) -> Scene:
    """Reads `path`/poses_bounds.npy and the images, which it lists in the order of their names.

    The world is oriented, centred and scaled over all views. The file's depth bounds are not used. The file knows
    neither distortion nor principal point: they are taken from the COLMAP model that lies beside it, if there is one.

    Args:
        path: the folder.
        images: folder of the images inside `path`, such as images_4; where it is missing, images_2, images_4 and
            images_8 are tried. Smaller images than the file's are fine.
        width: that of images which are wider, in pixels; the area filter reduces them to it.
        eval_every: every so many views one is held out, the first view among them; None: 10 % of the views.

    Raises:
        ValueError: one line that names the mistake and the file or image.
    """
    folder = SceneFolder(path)
    file = folder.file(FILE)
    table = read_table(file)
    places = [folder.path / images, *(folder.path / f"{images}_{factor}" for factor in SMALLER)]
    found = next((names for place in places if (names := photographs(place))), [])
    if len(found) != len(table):
        raise ValueError(
            f"{file} has {len(table)} poses, but {folder.path / images} has {len(found)} images"
            f"{contents(folder.path, [FILE])}"
        )
    listed = [posed_image(folder, image, row) for image, row in zip(found, table, strict=True)]
    posed, remarks, read = with_lenses(folder, listed)
    capture = Capture("llff", folder, file, posed, remarks=remarks, read=[FILE, *read])
    return load_scene(capture, width, eval_every=eval_every)


def posed_image(folder: SceneFolder, image: Path, row: NDArray) -> PosedImage:
    down, right, backward, centre, (height, breadth, focal) = row[:15].reshape(3, 5).T.tolist()
    columns = right, [0.0 - value for value in down], backward, centre
    lens = {"w": breadth, "h": height, "fl_x": focal}
    return PosedImage(folder.relative(image), image, np.array(columns).T, lens)


def with_lenses(
    folder: SceneFolder, images: Sequence[PosedImage]
) -> tuple[Sequence[PosedImage], list[str], tuple[str, ...]]:
    """The images with the lenses of the COLMAP model in the folder; a remark; and what was read."""
    place, _ = find_model(folder.path)
    if place is None:
        return images, [], ()
    name = place.relative_to(folder.path).as_posix()
    try:
        lenses = {Path(frame["file_path"]).stem: frame for frame in read_model(place)["frames"]}
    except ValueError as error:
        return images, [f"lenses of {name} not used: {error}"], ()
    lacking = [image.name for image in images if Path(image.name).stem not in lenses]
    if lacking:
        return images, [f"lenses of {name} not used: it lacks {lacking[0]!r}"], ()
    found = [lenses[Path(image.name).stem] for image in images]
    ratios = [_relative_focal(lens) / _relative_focal(image.lens) for lens, image in zip(found, images, strict=True)]
    if max(abs(ratio - 1) for ratio in ratios) > SAME_LENS:
        return images, [f"lenses of {name} not used: focal lengths are {ratios[0]:.3g} times those of {FILE}"], ()
    read = place.relative_to(folder.path).parts[:1] or tuple(file.name for file in place.glob("*.*"))
    posed = [replace(image, lens=lens) for image, lens in zip(images, found, strict=True)]
    return posed, [f"distortion and principal point from {name}"], read


def _relative_focal(lens: Mapping[str, Any]) -> float:
    """Focal length in widths of the image."""
    return float(lens["fl_x"]) / float(lens["w"])


def read_table(file: Path) -> NDArray[np.float64]:
    """(V, 15 or more): each row is [down | right | backward | centre | height width focal] (3, 5), then bounds."""
    try:
        table = np.load(file, allow_pickle=False)
    except Exception as error:  # numpy raises many kinds of errors for a damaged file
        raise ValueError(f"{file} is no array that NumPy can read") from error
    if not isinstance(table, np.ndarray) or table.ndim != 2 or table.shape[1] < 15 or table.dtype.kind not in "fiu":
        raise ValueError(f"{file}: expected an array of V x 17 numbers, got {getattr(table, 'shape', type(table))}")
    return table.astype(np.float64)
