"""The synthetic-NeRF layout: transforms_train.json, transforms_val.json, transforms_test.json and RGBA images."""

from pathlib import Path

import numpy as np

from qnerf.scenes.base import SCENES, Scene
from qnerf.scenes.normalise import normalise
from qnerf.scenes.transforms import open_folder, present, read_frames, scene_from

NEAR, FAR = 2.0, 6.0  # by convention, in the source's units
SPLITS = ("test", "val")


@SCENES.register("blender")
def blender(
    *,
    path: str | Path,
    downscale: int = 1,
    eval_split: str = "test",
    eval_views: int | None = None,
    skip_missing: bool = False,
) -> Scene:
    """Reads the training views and those of one other split. World: the source's, scaled so that the largest absolute
    camera coordinate over both splits is 1; near 2 and far 6 are scaled with it.

    Args:
        path: the folder.
        downscale: integer factor by which the images are made smaller, by an area filter.
        eval_split: test or val.
        eval_views: how many of that split's views to evaluate, evenly spread; None for all.
        skip_missing: leave out frames whose image is missing.

    Raises:
        ValueError: one line that names what is wrong and where.
    """
    if eval_split not in SPLITS:
        raise ValueError(f"scene=blender: eval_split must be one of {', '.join(SPLITS)}, got {eval_split!r}")
    if eval_views is not None and eval_views < 1:
        raise ValueError(f"scene=blender: eval_views must be at least 1, or null for all, got {eval_views}")
    folder = open_folder(path)
    files = {split: folder / f"transforms_{split}.json" for split in ("train", eval_split)}
    for file in files.values():
        if not file.is_file():
            plain = (folder / "transforms.json").is_file()
            hint = "; it has transforms.json: use scene=nerfstudio" if plain else ""
            raise ValueError(f"scene.path={str(path)!r} has no {file.name}{hint}")
    train, held_out = (read_frames(folder, file) for file in files.values())
    kept = present(folder, [*train, *held_out], skip_missing)
    count = sum(frame.file is not None for frame in train)
    if count == 0 or count == len(kept):
        raise ValueError(f"{folder}: no image of the {'train' if count == 0 else eval_split} split exists")
    both = {frame.key for frame in kept[:count]} & {frame.key for frame in kept[count:]}
    if both:
        raise ValueError(f"{folder}: image {min(both)!r} is in the training and in the evaluation split")
    try:
        poses, transform = normalise(np.stack([frame.pose for frame in kept]), orient=False, centre=False)
    except ValueError as error:
        raise ValueError(f"{folder}: {error}") from error
    used = [*range(count), *(count + index for index in even_subset(len(kept) - count, eval_views))]
    scale = float(transform[0, 0])
    return scene_from(
        "blender",
        folder,
        [kept[index] for index in used],
        list(range(count)),
        list(range(count, len(used))),
        poses[used],
        transform,
        downscale,
        bounds=(NEAR * scale, FAR * scale),
    )


def even_subset(items: int, most: int | None) -> list[int]:
    """At most `most` of range(items), evenly spread."""
    if most is None or most >= items:
        return list(range(items))
    return [int((2 * index + 1) * items / (2 * most)) for index in range(most)]
