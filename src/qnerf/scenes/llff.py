"""An LLFF folder: poses_bounds.npy and images (arXiv:1905.00889)."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from qnerf.config.bounds import Count
from qnerf.scenes.base import SCENES, Scene, split_views
from qnerf.scenes.folders import find_file, photographs
from qnerf.scenes.images import SMALLER
from qnerf.scenes.loading import load_scene
from qnerf.scenes.transforms import frames_of, with_images


@SCENES.register("llff")
def llff(
    *,
    path: str | Path,
    images: str = "images",
    downscale: Count = 1,
    width: Count | None = None,
    eval_every: Count | None = 8,
) -> Scene:
    """Reads `path`/poses_bounds.npy and the images, which it lists in the order of their names.

    The world is oriented, centred and scaled over all views. The file's depth bounds are not used.

    Args:
        path: the folder.
        images: folder of the images inside `path`, such as images_4; where it is missing, images_2, images_4 and
            images_8 are tried. Smaller images than the file's are fine.
        downscale: integer factor by which images are reduced, with an area filter.
        width: that of images which are wider, in pixels; the area filter reduces them to it.
        eval_every: every so many views one is held out, the first view among them; None: 10 % of the views.

    Raises:
        ValueError: one line that names the mistake and the file or image.
    """
    file = find_file(path, "poses_bounds.npy")
    folder = file.parent
    table = read_table(file)
    places = [folder / images, *(folder / f"{images}_{factor}" for factor in SMALLER)]
    found = next((names for place in places if (names := photographs(place))), [])
    if len(found) != len(table):
        raise ValueError(f"{file} has {len(table)} poses, but {folder / images} has {len(found)} images")
    frames = []
    for image, row in zip(found, table, strict=True):
        down, right, backward, centre, (height, breadth, focal) = row[:15].reshape(3, 5).T.tolist()
        columns = right, [0.0 - value for value in down], backward, centre
        matrix = [[column[axis] for column in columns] for axis in range(3)]
        own = {"w": breadth, "h": height, "fl_x": focal}
        frames.append({"file_path": image.relative_to(folder).as_posix(), "transform_matrix": matrix, **own})
    listed = with_images(folder, frames_of(folder, file, {"frames": frames}), False)
    train, held_out = split_views(len(listed), eval_every)
    return load_scene("llff", folder, listed, train, held_out, downscale, width, recentre=True)


def read_table(file: Path) -> NDArray[np.float64]:
    """(V, 15 or more): each row is [down | right | backward | centre | height width focal] (3, 5), then bounds."""
    try:
        table = np.load(file, allow_pickle=False)
    except Exception as error:  # numpy raises many kinds of errors for a damaged file
        raise ValueError(f"{file} is no array that NumPy can read") from error
    if not isinstance(table, np.ndarray) or table.ndim != 2 or table.shape[1] < 15 or table.dtype.kind not in "fiu":
        raise ValueError(f"{file}: expected an array of V x 17 numbers, got {getattr(table, 'shape', type(table))}")
    return table.astype(np.float64)
