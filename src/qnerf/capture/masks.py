"""Masks of photographs: features are not looked for where they are black, and the scene's frames name them."""

from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

from qnerf.scenes.folders import PHOTOGRAPHS, photographs
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
    found = photographs(folder)
    names = [path.name for path in photographs(taken)]
    if not found:
        kinds = ", ".join(kind[1:] for kind in PHOTOGRAPHS)
        raise ValueError(f"masks: expected images ({kinds}) named as the photographs in {folder}, got none")
    mask_of: dict[str, Path] = {}
    for path in found:
        fitting = [name for name in names if path.stem in (name, Path(name).stem)]
        if not fitting:
            some = f"the name of one, such as {Path(names[0]).stem}.png"
            raise ValueError(f"masks: {path} belongs to no photograph that was given; expected {some}")
        for name in fitting:
            if mask_of.setdefault(name, path) != path:
                raise ValueError(f"masks: {mask_of[name]} and {path} are both masks of {name}; expected one")
    for name in names:
        with Image.open(taken / name) as image:
            size = image.size
        if name not in mask_of:
            Image.new("L", size, 255).save(out / f"{name}.png")
            continue
        path = mask_of[name]
        open_header(folder, path)
        try:
            with Image.open(path) as image:
                counts = np.asarray(ImageOps.exif_transpose(image).convert("L")) > 0
        except (OSError, SyntaxError, ValueError) as error:
            raise ValueError(f"masks: {path} does not decode: {error}") from error
        if counts.shape != size[::-1]:
            has = f"{counts.shape[1]} x {counts.shape[0]}"
            raise ValueError(
                f"masks: {path} has {has} pixels, expected those of {name} held upright, {size[0]} x {size[1]}"
            )
        Image.fromarray(255 * counts.astype(np.uint8)).save(out / f"{name}.png")
    return len(mask_of)
