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
FILES = {split: f"transforms_{split}.json" for split in ("train", "val", "test")}
FORMATS["blender"] = tuple(FILES.values())


@SCENES.register("blender")
def blender(
    *,
    path: str | Path,
    width: Count | None = None,
    eval_split: Literal["test", "val"] = "test",
    eval_views: PositiveInt | None = None,
    skip_missing: bool = False,
) -> Scene:
    """Reads the training split and one evaluation split.

    The world is the source's, scaled so that the largest absolute camera coordinate over both splits is 1. Near 2 and
    far 6 are scaled with it. Where the evaluation split has no file or no image, the other one is read; where both have
    none, 10 % of the training views are held out.

    Args:
        path: the folder.
        width: that of images which are wider, in pixels; the area filter reduces them to it.
        eval_split: test or val.
        eval_views: number of evaluation views, evenly spread over the split; None for all.
        skip_missing: leave out frames whose image is missing.

    Raises:
        ValueError: one line that names the mistake and the file or frame.
    """
    capture = read_splits(SceneFolder(path), eval_split, eval_views, skip_missing)
    return load_scene(capture, width, skip_missing=skip_missing)


def read_splits(folder: SceneFolder, eval_split: str, eval_views: int | None, skip_missing: bool) -> Capture:
    """The images of transforms_train.json, or of the only file that is there, and those that are held out."""
    there = {split: folder.path / name for split, name in FILES.items() if (folder.path / name).is_file()}
    first = "train" if "train" in there or not there else next(iter(there))
    contents = {first: read_json(folder.file(FILES[first]))}
    images = posed_images(folder, there[first], contents[first])
    held_out: list[PosedImage] = []
    for split in (eval_split, "val" if eval_split == "test" else "test"):
        if split in there and split != first and not any(image.file for image in held_out):
            contents[split] = read_json(there[split])
            held_out, evaluated = posed_images(folder, there[split], contents[split]), split
    remarks = list(unread_keys(*contents.values()))
    if any(image.file for image in held_out):
        if evaluated != eval_split:
            remarks.insert(0, f"{FILES[evaluated]} is held out: {FILES[eval_split]} has no images")
        held_out = [image for image in held_out if image.file or not skip_missing]
        chosen = set(even_subset(len(held_out), eval_views))
        images = [replace(image, use="train") for image in images]
        images += [replace(image, use="eval" if index in chosen else "unused") for index, image in enumerate(held_out)]
    else:
        remarks.insert(0, f"one in ten views of {FILES[first]} is held out: no other split has images")
    read = tuple(FILES.values())
    return Capture("blender", folder, there[first], images, recentre=False, bounds=BOUNDS, remarks=remarks, read=read)
