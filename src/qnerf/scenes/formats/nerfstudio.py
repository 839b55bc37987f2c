"""A nerfstudio or instant-ngp folder: transforms.json and images."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from qnerf.config.bounds import Count
from qnerf.scenes.base import SCENES, Scene
from qnerf.scenes.folders import FORMATS, SceneFolder
from qnerf.scenes.formats.transforms import normal, posed_images, read_json, unread_keys
from qnerf.scenes.loading import Capture, PosedImage, load_scene

FILE = "transforms.json"
FORMATS["nerfstudio"] = (FILE,)


@SCENES.register("nerfstudio")
def nerfstudio(*, path: str | Path, width: Count | None = None, skip_missing: bool = False) -> Scene:
    """Reads `path`/transforms.json. Views are in the order of their file names.

    Intrinsics are fl_x fl_y cx cy k1 k2 p1 p2, or camera_angle_x, x_fov or K, shared or per frame; those of
    OPENCV_FISHEYE are fl_x fl_y cx cy k1 k2 k3 k4. The split is the file's train_filenames and test_filenames (else
    val_filenames); without them 90 % of the views train. The world is oriented, centred and scaled over all frames,
    used or not. Black pixels of a frame's mask_path are neither trained on nor measured, nor are pixels that are not
    black in instant-ngp's dynamic_mask_NAME.png.

    Where images/NAME is missing, images_2/NAME, images_4/NAME or images_8/NAME is read. If w and h are those of larger
    images of the same shape, the intrinsics are scaled.

    Args:
        path: the folder.
        width: that of images which are wider, in pixels; the area filter reduces them to it.
        skip_missing: leave out frames whose image is missing.

    Raises:
        ValueError: one line that names the mistake and the file or frame.
    """
    folder = SceneFolder(path)
    file = folder.file(FILE)
    content = read_json(file)
    images = sorted(posed_images(folder, file, content), key=lambda image: image.name)
    capture = Capture(
        "nerfstudio",
        folder,
        file,
        assigned(folder, file, content, images),
        remarks=list(unread_keys(content)),
        read=[FILE],
    )
    return load_scene(capture, width, skip_missing=skip_missing)


def assigned(
    folder: SceneFolder, file: Path, content: Mapping[str, Any], images: Sequence[PosedImage]
) -> Sequence[PosedImage]:
    """The images with the use that train_filenames, test_filenames and val_filenames give them."""
    known = {normal(image.name) for image in images}
    name_of: dict[Path | None, str] = {image.file: normal(image.name) for image in images if image.file is not None}

    def listed(key: str) -> set[str] | None:
        names = content.get(key)
        if names is None or names == []:
            return None
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ValueError(f"{file}: {key} must be a list of file names")
        found = set()
        for name in names:
            image = normal(name) if normal(name) in known else name_of.get(folder.image(name))
            if image is None:
                raise ValueError(f"{file}: {key} names {name!r}, which is no frame")
            found.add(image)
        return found

    train, held_out, val = (listed(f"{split}_filenames") for split in ("train", "test", "val"))
    if held_out is None:
        held_out = val
    if train is None and held_out is None:
        return images
    train = known - (held_out or set()) if train is None else train
    held_out = known - train if held_out is None else held_out
    if both := train & held_out:
        raise ValueError(f"{file}: image {min(both)!r} is in the training and in the evaluation split")
    return [
        replace(image, use="train" if key in train else "eval" if key in held_out else "unused")
        for image, key in ((image, normal(image.name)) for image in images)
    ]
