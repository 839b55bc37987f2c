"""A nerfstudio or instant-ngp folder: transforms.json and images."""

import posixpath
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from qnerf.scenes.base import SCENES, Scene, split_views
from qnerf.scenes.normalise import normalise
from qnerf.scenes.transforms import Frame, open_folder, present, read_frames, scene_from


@SCENES.register("nerfstudio")
def nerfstudio(*, path: str | Path, downscale: int = 1, skip_missing: bool = False) -> Scene:
    """Reads `path`/transforms.json; world: oriented, centred and scaled over all frames, in the order of file names.

    Intrinsics are fl_x fl_y cx cy k1 k2 p1 p2, or camera_angle_x, shared or per frame. The split is the file's
    train_filenames and test_filenames (else val_filenames) where it has them, else nine views in ten train. Masks and
    depth files that it may name are not used.

    Args:
        path: the folder.
        downscale: integer factor by which the images are made smaller, by an area filter.
        skip_missing: leave out frames whose image is missing.

    Raises:
        ValueError: one line that names what is wrong and where.
    """
    folder = open_folder(path)
    file = folder / "transforms.json"
    if not file.is_file():
        blender = (folder / "transforms_train.json").is_file()
        hint = "; it has transforms_train.json: use scene=blender" if blender else ""
        raise ValueError(f"scene.path={str(path)!r} has no transforms.json{hint}")
    listed = read_frames(folder, file)
    frames = sorted(present(folder, listed, skip_missing), key=lambda frame: frame.name)
    try:
        poses, transform = normalise(np.stack([frame.pose for frame in frames]))
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error
    train, held_out = _split(file, listed, frames)
    used = sorted({*train, *held_out})
    position = {index: place for place, index in enumerate(used)}
    return scene_from(
        "nerfstudio",
        folder,
        [frames[index] for index in used],
        [position[index] for index in train],
        [position[index] for index in held_out],
        poses[used],
        transform,
        downscale,
    )


def _split(file: Path, listed: Sequence[Frame], frames: Sequence[Frame]) -> tuple[list[int], list[int]]:
    """Training and evaluation indices into `frames`; `listed` are all frames of the file, with or without image."""
    content = listed[0].shared
    known = {frame.key for frame in listed}
    place = {frame.key: index for index, frame in enumerate(frames)}

    def chosen(key: str) -> list[int] | None:
        names = content.get(key)
        if not names:
            return None
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ValueError(f"{file}: {key} must be a list of file names")
        keys = [posixpath.normpath(name) for name in names]
        for name, normal in zip(names, keys, strict=True):
            if normal not in known:
                raise ValueError(f"{file}: {key} names {name!r}, which is no frame")
        return sorted({place[normal] for normal in keys if normal in place})

    train, held_out = chosen("train_filenames"), chosen("test_filenames")
    if held_out is None:
        held_out = chosen("val_filenames")
    if train is None and held_out is None:
        return split_views(len(frames))
    if train is None:
        train = sorted(set(range(len(frames))) - set(held_out or []))
    if held_out is None:
        held_out = sorted(set(range(len(frames))) - set(train))
    both = sorted(set(train) & set(held_out))
    if both:
        raise ValueError(f"{file}: image {frames[both[0]].name!r} is in the training and in the evaluation split")
    if not train or not held_out:
        raise ValueError(f"{file}: the split leaves no image to {'evaluate' if train else 'train'}")
    return train, held_out
