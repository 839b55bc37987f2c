"""A nerfstudio or instant-ngp folder: transforms.json and images."""

import posixpath
from collections.abc import Sequence
from pathlib import Path

from qnerf.config.bounds import Count
from qnerf.scenes.base import SCENES, Scene, split_views
from qnerf.scenes.folders import find_file
from qnerf.scenes.loading import load_scene
from qnerf.scenes.transforms import Frame, read_frames, with_images


@SCENES.register("nerfstudio")
def nerfstudio(
    *, path: str | Path, downscale: Count = 1, width: Count | None = None, skip_missing: bool = False
) -> Scene:
    """Reads `path`/transforms.json. Views are in the order of their file names.

    Intrinsics are fl_x fl_y cx cy k1 k2 p1 p2, or camera_angle_x, shared or per frame; those of OPENCV_FISHEYE are
    fl_x fl_y cx cy k1 k2 k3 k4. The split is the file's train_filenames and test_filenames (else val_filenames);
    without them 90 % of the views train. The world is oriented, centred and scaled over all frames, used or not. Black
    pixels of a frame's mask_path are neither trained on nor measured. Depth files are ignored.

    Where images/NAME is missing, images_2/NAME, images_4/NAME or images_8/NAME is read. If w and h are those of larger
    images of the same shape, the intrinsics are scaled.

    Args:
        path: the folder.
        downscale: integer factor by which images are reduced, with an area filter.
        width: that of images which are wider, in pixels; the area filter reduces them to it.
        skip_missing: leave out frames whose image is missing.

    Raises:
        ValueError: one line that names the mistake and the file or frame.
    """
    file = find_file(path, "transforms.json")
    listed = read_frames(file.parent, file)
    frames = sorted(with_images(file.parent, listed, skip_missing), key=lambda frame: frame.name)
    train, held_out = _split(file, listed, frames)
    return load_scene("nerfstudio", file.parent, frames, train, held_out, downscale, width, recentre=True)


def _split(file: Path, listed: Sequence[Frame], frames: Sequence[Frame]) -> tuple[list[int], list[int]]:
    """Training and evaluation indices into `frames`; `listed` includes frames without an image."""
    content = listed[0].shared
    known = {frame.key for frame in listed}
    index_of = {frame.key: index for index, frame in enumerate(frames)}

    def indices(key: str) -> list[int] | None:
        names = content.get(key)
        if names is None or names == []:
            return None
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ValueError(f"{file}: {key} must be a list of file names")
        keys = [posixpath.normpath(name) for name in names]
        for name, normal in zip(names, keys, strict=True):
            if normal not in known:
                raise ValueError(f"{file}: {key} names {name!r}, which is no frame")
        return sorted({index_of[normal] for normal in keys if normal in index_of})

    train, held_out = indices("train_filenames"), indices("test_filenames")
    if held_out is None:
        held_out = indices("val_filenames")
    if train is None and held_out is None:
        return split_views(len(frames))
    every = set(range(len(frames)))
    if train is None:
        train = sorted(every - set(held_out or []))
    if held_out is None:
        held_out = sorted(every - set(train))
    return train, held_out
