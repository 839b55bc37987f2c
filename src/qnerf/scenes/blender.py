"""The synthetic-NeRF layout: transforms_train.json, transforms_val.json, transforms_test.json and RGBA images."""

from pathlib import Path
from typing import Literal

from qnerf.config.bounds import Count, PositiveInt
from qnerf.scenes.base import SCENES, Scene, even_subset
from qnerf.scenes.folders import find_file
from qnerf.scenes.loading import load_scene
from qnerf.scenes.transforms import read_frames, with_images

BOUNDS = (2.0, 6.0)  # near and far by convention, in the source's units


@SCENES.register("blender")
def blender(
    *,
    path: str | Path,
    downscale: Count = 1,
    width: Count | None = None,
    eval_split: Literal["test", "val"] = "test",
    eval_views: PositiveInt | None = None,
    skip_missing: bool = False,
) -> Scene:
    """Reads the training split and one evaluation split.

    The world is the source's, scaled so that the largest absolute camera coordinate over both splits is 1. Near 2 and
    far 6 are scaled with it.

    Args:
        path: the folder.
        downscale: integer factor by which images are reduced, with an area filter.
        width: that of images which are wider, in pixels; the area filter reduces them to it.
        eval_split: test or val.
        eval_views: number of evaluation views, evenly spread over the split; None for all.
        skip_missing: leave out frames whose image is missing.

    Raises:
        ValueError: one line that names the mistake and the file or frame.
    """
    files = [find_file(path, f"transforms_{split}.json") for split in ("train", eval_split)]
    folder = files[0].parent
    train, held_out = (read_frames(folder, file) for file in files)
    frames = with_images(folder, [*train, *held_out], skip_missing)
    count = sum(frame.file is not None for frame in train)
    evaluated = [count + index for index in even_subset(len(frames) - count, eval_views)]
    return load_scene(
        "blender", folder, frames, list(range(count)), evaluated, downscale, width, recentre=False, bounds=BOUNDS
    )
