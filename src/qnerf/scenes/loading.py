"""Puts a scene together from frames: images, masks, cameras, the normalised world, and the fingerprint."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from qnerf.scenes.base import Cameras, Scene, digest
from qnerf.scenes.images import open_header, read_images, read_masks, reduced_sizes
from qnerf.scenes.intrinsics import check_lenses, intrinsics, stated_intrinsics
from qnerf.scenes.normalise import normalise
from qnerf.scenes.transforms import Frame

FINGERPRINT = "2"  # raise it whenever `fingerprint` hashes something else


def load_scene(
    name: str,
    folder: Path,
    frames: Sequence[Frame],
    train: list[int],
    held_out: list[int],
    downscale: int,
    width: int | None,
    *,
    recentre: bool,
    bounds: tuple[float, float] | None = None,
) -> Scene:
    """Reads the images of the split and puts the scene together.

    Args:
        name: of the scene reader.
        frames: the world is normalised over all of them, used or not.
        train, held_out: indices into `frames`.
        downscale: integer factor by which images are reduced.
        width: that of images which are wider, in pixels; None: `downscale` decides.
        recentre: orient and centre the world; else it is only scaled.
        bounds: near and far in the source's units.

    Raises:
        ValueError: an image is in both splits, a split is empty, or poses, images or intrinsics are not usable.
    """
    trained = {frames[index].file_id for index in train}
    both = [frames[index].key for index in held_out if frames[index].file_id in trained]
    if both:
        raise ValueError(f"{folder}: image {min(both)!r} is in the training and in the evaluation split")
    if not train or not held_out:
        raise ValueError(f"{folder}: the split leaves no image to {'evaluate' if train else 'train'}")
    try:
        poses, transform = normalise(np.stack([frame.pose for frame in frames]), orient=recentre, centre=recentre)
    except ValueError as error:
        raise ValueError(f"{folder}: {error}") from error
    matrices = [frame.matrix for frame in frames]
    used = sorted({*train, *held_out})
    train, held_out = [used.index(index) for index in train], [used.index(index) for index in held_out]
    frames = [frames[index] for index in used]
    files = [open_header(folder, frame.name, frame.file) for frame in frames if frame.file is not None]
    masks = [open_header(folder, str(frame.own["mask_path"]), frame.mask) if frame.mask else None for frame in frames]
    sizes = reduced_sizes(f"scene={name}", files, downscale, width)
    labels = [f"{folder}: frame {frame.name!r}" for frame in frames]
    stated = [stated_intrinsics(frame.own, frame.shared, label) for frame, label in zip(frames, labels, strict=True)]
    table = np.array(
        [
            intrinsics(numbers, file.width, file.height, label)
            for numbers, file, label in zip(stated, files, labels, strict=True)
        ]
    )
    fisheye = np.array(["fisheye" in numbers for numbers in stated])
    full = np.array([(file.width, file.height) for file in files])
    check_lenses(labels, table, full, fisheye)
    images, hashes = read_images(folder, files, sizes, downscale)
    mask, mask_hashes = read_masks(folder, files, masks, sizes, downscale)
    views = [
        {"frame": index, "image": file.name, "content": content, "lens": numbers} | ({"mask": black} if black else {})
        for index, file, content, numbers, black in zip(used, files, hashes, stated, mask_hashes, strict=True)
    ]
    if width is None:
        table[:, :4] /= downscale
    else:
        table[:, :4] *= np.tile(np.array(sizes) / full, 2)
    scale = float(np.linalg.norm(transform[:3, 0]))
    near, far = (None, None) if bounds is None else (bounds[0] * scale, bounds[1] * scale)
    return Scene(
        name=name,
        images=torch.from_numpy(images),
        cameras=Cameras.from_arrays(poses[used], table, np.array(sizes), fisheye),
        train=train,
        eval=held_out,
        names=[file.name for file in files],
        fingerprint=fingerprint(name, matrices, views, train, held_out, downscale, width),
        transform=torch.from_numpy(transform),
        near=near,
        far=far,
        mask=None if mask is None else torch.from_numpy(mask),
        masks=sum(black is not None for black in mask_hashes),
    )


def fingerprint(
    name: str,
    matrices: Sequence[NDArray],
    views: Sequence[Mapping[str, Any]],
    train: Sequence[int],
    held_out: Sequence[int],
    downscale: int,
    width: int | None = None,
) -> str:
    """A hash of what the scene is read from. Nothing in it was computed, so every machine finds the same.

    Args:
        name: of the scene reader.
        matrices: (3, 4) as written, of all frames over which the world is normalised.
        views: of each view, its index into `matrices`, its image, the hash of the image file, and the numbers that
            decide its intrinsics, as written; the hash of its mask if it has one.
        train, held_out: indices into `views`.
    """
    content = {
        "reader": name,
        "matrices": [matrix.tolist() for matrix in matrices],
        "views": views,
        "train": train,
        "held_out": held_out,
        "downscale": downscale,
    } | ({} if width is None else {"width": width})
    return digest("scene", FINGERPRINT, json.dumps(content, sort_keys=True, allow_nan=False))
