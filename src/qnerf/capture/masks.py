"""Masks of photographs: features are not looked for where they are black, and the scene's frames name them."""

from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

from qnerf.scenes.folders import PHOTOGRAPHS, SceneFolder, photographs
from qnerf.scenes.images import open_header


def collect_masks(folder: Path, taken: Path, out: Path) -> int:
    """Writes NAME.png, grey of 0 or 255, to `out` for each photograph NAME in `taken`; white if `folder` has no mask.

    A mask is an image with the photograph's name up to its ending, or with the whole name and an ending of its own:
    the mask of a.jpg is a.png or a.jpg.png. Only 0 is black.

    Returns:
        The number of photographs with a mask.

    Raises:
        ValueError: there are no masks; one has no photograph, does not decode, or has another size; a photograph has
            two.
    """
    if not folder.is_dir():
        raise ValueError(f"masks: {folder} {'is no folder' if folder.exists() else 'does not exist'}")
    masks, names = SceneFolder(folder), [path.name for path in photographs(taken)]
    mask_of = {name: path for name in names if (path := masks.image(name) or masks.image(Path(name).stem))}
    others = sorted({*photographs(folder)} - {*mask_of.values()})
    if others or not mask_of:
        kinds = ", ".join(kind[1:] for kind in PHOTOGRAPHS)
        expected = f"expected one image ({kinds}) for each photograph, named as it, such as {Path(names[0]).stem}.png"
        what = f"{others[0]} belongs to no photograph, or is a second one" if others else f"{folder} has none"
        raise ValueError(f"masks: {what}; {expected}")
    for name in names:
        with Image.open(taken / name) as image:
            size = image.size
        counts = np.ones(size[::-1], dtype=bool)
        if name in mask_of:
            open_header(folder, mask_of[name])
            try:
                with Image.open(mask_of[name]) as image:
                    counts = np.asarray(ImageOps.exif_transpose(image).convert("L")) > 0
            except (OSError, SyntaxError, ValueError) as error:
                raise ValueError(f"masks: {mask_of[name]} does not decode: {error}") from error
        if counts.shape != size[::-1]:
            has = f"{counts.shape[1]} x {counts.shape[0]}"
            raise ValueError(
                f"masks: {mask_of[name]} has {has} pixels, expected those of {name} held upright, {size[0]} x {size[1]}"
            )
        Image.fromarray(255 * counts.astype(np.uint8)).save(out / f"{name}.png")
    return len(mask_of)
