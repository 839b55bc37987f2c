"""The synthetic-NeRF layout: transforms_train.json, transforms_val.json, transforms_test.json and RGBA images."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

from qnerf.config.bounds import Count, PositiveInt
from qnerf.scenes.base import SCENES, Scene, even_subset
from qnerf.scenes.folders import FORMATS, SceneFolder
from qnerf.scenes.formats.transforms import posed_images, read_json, unread_keys
from qnerf.scenes.loading import Capture, PosedImage, load_scene

BOUNDS = (2.0, 6.0)  # near and far by convention, in the source's units
TRAIN = "transforms_train.json"
FORMATS["blender"] = (TRAIN,)


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
    far 6 are scaled with it. Where the evaluation split has no file or no image, 10 % of the training views are held
    out.

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
    folder = SceneFolder(path)
    files = [folder.file(TRAIN)]
    other = folder.path / f"transforms_{eval_split}.json"
    files += [other] if other.is_file() else []
    contents = [read_json(file) for file in files]
    images, *rest = (posed_images(folder, file, content) for file, content in zip(files, contents, strict=True))
    held_out = [image for image in (rest[0] if rest else []) if not skip_missing or image.file is not None]
    remarks = list(unread_keys(*contents))
    if any(image.file is not None for image in held_out):
        images = [replace(image, use="train") for image in images] + evaluated(held_out, eval_views)
    else:
        without = "has no image" if rest else "does not exist"
        remarks.insert(0, f"{other.name} {without}, so one in ten views of {TRAIN} is held out")
    read = [f"transforms_{split}.json" for split in ("train", "val", "test")]
    capture = Capture("blender", folder, files[0], images, recentre=False, bounds=BOUNDS, remarks=remarks, read=read)
    return load_scene(capture, downscale, width, skip_missing=skip_missing)


def evaluated(images: list[PosedImage], limit: int | None) -> list[PosedImage]:
    """The evaluation split, of which at most `limit` images are measured."""
    chosen = set(even_subset(len(images), limit))
    return [replace(image, use="eval" if index in chosen else "unused") for index, image in enumerate(images)]
