"""Puts a scene together from what a reader of a format found: images, masks, cameras, the normalised world.

A format is one module in `qnerf.scenes.formats`. It returns a `Capture`; everything else is done here.
"""

import json
import posixpath
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from qnerf.scenes.base import MIN_VIEWS, Cameras, Scene, digest, split_views
from qnerf.scenes.folders import SMALLER, SceneFolder, photographs
from qnerf.scenes.images import ImageFile, Mask, open_header, read_images, read_masks, reduced_sizes
from qnerf.scenes.intrinsics import CROP, FOCAL, check_lenses, intrinsics, stated_intrinsics
from qnerf.scenes.normalise import far_out, normalise, rigid

FINGERPRINT = "2"  # raise it whenever `fingerprint` hashes something else
MASKS = "masks"  # folder with a mask for each image, where no other mask is named
NAMED = 6  # most names in a remark


@dataclass(frozen=True)
class PosedImage:
    """An image as the files of a format describe it."""

    name: str  # as the format's file writes it
    file: Path | None  # None: missing
    matrix: NDArray  # (3 or 4, 4) float64, camera-to-world in the source's world, OpenGL's axes, as written
    lens: Mapping[str, Any]  # under the names of a transforms file: w h fl_x fl_y cx cy k1 ..., or camera_angle_x
    mask: Mask | None = None
    use: Literal["train", "eval", "unused"] | None = None  # None for all images: `split_views` decides
    points: NDArray | None = None  # (N, 3) float64 sparse points that it sees, in the source's world; None: not read


@dataclass(frozen=True)
class Capture:
    """Posed images of one scene, as a reader found them."""

    format: str
    folder: SceneFolder
    source: Path  # with the poses, for messages
    images: Sequence[PosedImage]  # in the order of the scene's views
    recentre: bool = True  # orient and centre the world; else it is only scaled
    bounds: tuple[float, float] | None = None  # near and far in the source's units
    remarks: list[str] = field(default_factory=list)  # see `Scene.remarks`
    read: Sequence[str] = ()  # what was read, directly in the folder, besides images and masks


def load_scene(
    capture: Capture, width: int | None, *, skip_missing: bool = False, eval_every: int | None = None
) -> Scene:
    """The scene with its images, reduced.

    Args:
        width: that of images which are wider, in pixels; None: images stay as they are.
        skip_missing: leave out images whose file is missing.
        eval_every: every so many views one is held out, the first view among them; None: 10 % of the views.

    Raises:
        ValueError: an image is missing, or named twice; a split is empty; poses, images, masks or intrinsics are not
            usable.
    """
    folder, name = capture.folder.path, capture.format
    posed = existing(capture, skip_missing, eval_every)
    check_unique(capture.source, posed)
    poses, transform, scales = normalised(capture, posed)
    used, train, held_out = used_views(folder, posed, eval_every)
    views = with_masks(capture.folder, [posed[index] for index in used])
    files = [open_header(folder, image.file) for image in views if image.file is not None]
    sizes = reduced_sizes(f"scene={name}", files, width)
    lenses, table, fisheye = read_lenses(capture.source, views, files)
    images, hashes = read_images(folder, files, sizes)
    radii = [
        lens[CROP] * file.width / (lens.get("w") or file.width) if CROP in lens else None
        for lens, file in zip(lenses, files, strict=True)
    ]
    mask, mask_hashes = read_masks(folder, files, [image.mask for image in views], radii, sizes)
    contents = [
        {"frame": index, "image": file.name, "content": content, "lens": lens}
        | ({"mask": black} if black else {})
        | ({} if image.points is None else {"points": digest(image.points)})
        for index, image, file, content, lens, black in zip(
            used, views, files, hashes, lenses, mask_hashes, strict=True
        )
    ]
    full = np.array([(file.width, file.height) for file in files])
    table[:, :4] *= np.tile(np.array(sizes) / full, 2)
    scale = float(np.linalg.norm(transform[:3, 0]))
    near, far = (None, None) if capture.bounds is None else (bound * scale for bound in capture.bounds)
    return Scene(
        name=name,
        images=torch.from_numpy(images),
        cameras=Cameras.from_arrays(poses[used], table, np.array(sizes), fisheye),
        train=train,
        eval=held_out,
        names=[file.name for file in files],
        fingerprint=fingerprint(name, posed, contents, train, held_out, width),
        transform=torch.from_numpy(transform),
        near=near,
        far=far,
        mask=None if mask is None else torch.from_numpy(mask),
        masks=sum(image.mask is not None for image in views),
        points=sparse_points(views, transform),
        remarks=(
            *capture.remarks,
            *scaled(scales),
            *outlying(posed),
            *upright(lenses, files),
            *unread(capture, posed, views),
        ),
    )


def sparse_points(views: Sequence[PosedImage], transform: NDArray) -> torch.Tensor | None:
    """`Scene.points` of the views, led to the normalised world; None if none were read."""
    seen = [(view, image.points) for view, image in enumerate(views) if image.points is not None]
    if not seen:
        return None
    rows = [
        np.column_stack([np.full(len(points), view), points @ transform[:3, :3].T + transform[:3, 3]])
        for view, points in seen
    ]
    return torch.from_numpy(np.concatenate(rows))


def existing(capture: Capture, skip_missing: bool, eval_every: int | None) -> list[PosedImage]:
    """The images whose file exists.

    Raises:
        ValueError: a file is missing and `skip_missing` is false, or fewer than three exist. The message says what may
            be done about it.
    """
    images, folder = capture.images, capture.folder
    missing = [image.name for image in images if image.file is None]
    found = [image for image in images if image.file is not None]
    enough = len(found) >= MIN_VIEWS
    if enough and (skip_missing or not missing):
        return found
    place = folder.path / posixpath.dirname((missing or [image.name for image in images])[0].replace("\\", "/"))
    others = [path for path in photographs(place) if path not in {image.file for image in found}]
    there = f"; {place} has {len(others)} other images, such as {others[0].name!r}" if others else ""
    if not missing:
        raise ValueError(f"{folder.path}: expected poses of at least {MIN_VIEWS} images, got {len(found)}{there}")
    told = f"{folder.path}: {len(missing)} of {len(images)} images are missing, the first is {missing[0]!r}"
    if enough and all(split_of(found, eval_every)):
        raise ValueError(f"{told}; scene.skip_missing=true goes on with the other {len(found)}")
    needed = f"at least {MIN_VIEWS}, to train on and to hold out,"
    raise ValueError(f"{told}; {needed} are needed{there}")


def check_unique(source: Path, images: Sequence[PosedImage]) -> None:
    """ValueError if two of the images are one file."""
    first: dict[Path, PosedImage] = {}
    for image in images:
        assert image.file is not None
        other = first.setdefault(image.file.resolve(), image)
        if other is not image and {other.use, image.use} == {"train", "eval"}:
            raise ValueError(f"{source}: image {image.name!r} is in the training and in the evaluation split")
        if other is not image:
            raise ValueError(f"{source} names one image file twice: as {other.name!r} and as {image.name!r}")


def normalised(capture: Capture, images: Sequence[PosedImage]) -> tuple[NDArray, NDArray, NDArray]:
    """Poses (V, 3, 4) in the normalised world, the similarity that leads there, and by what rotations were scaled."""
    found = [rigid(image.matrix, f"{capture.source}: frame {image.name!r}") for image in images]
    try:
        poses = np.stack([pose for pose, _ in found])
        poses, transform = normalise(poses, orient=capture.recentre, centre=capture.recentre)
    except ValueError as error:
        raise ValueError(f"{capture.folder.path}: {error}") from error
    return poses, transform, np.array([scale for _, scale in found])


def read_lenses(
    source: Path, images: Sequence[PosedImage], files: Sequence[ImageFile]
) -> tuple[list[dict[str, float]], NDArray, NDArray[np.bool_]]:
    """The numbers of each lens as written, intrinsics (V, 8) in pixels of the files, and which are fisheyes (V,)."""
    labels = [f"{source}: frame {image.name!r}" for image in images]
    lenses = [stated_intrinsics(image.lens, label) for image, label in zip(images, labels, strict=True)]
    entries = zip(lenses, files, labels, strict=True)
    table = np.array([intrinsics(lens, file.width, file.height, label) for lens, file, label in entries])
    fisheye = np.array(["fisheye" in lens for lens in lenses])
    check_lenses(labels, table, np.array([(file.width, file.height) for file in files]), fisheye)
    return lenses, table, fisheye


def split_of(images: Sequence[PosedImage], eval_every: int | None) -> tuple[list[int], list[int]]:
    """Indices of the training and of the held-out images."""
    if all(image.use is None for image in images):
        return split_views(len(images), eval_every)
    train, held_out = ([index for index, image in enumerate(images) if image.use == use] for use in ("train", "eval"))
    return train, held_out


def used_views(
    folder: Path, images: Sequence[PosedImage], eval_every: int | None
) -> tuple[list[int], list[int], list[int]]:
    """Indices of the images that train or are held out, and among these the indices of both kinds.

    Raises:
        ValueError: no view trains, or no view is held out.
    """
    train, held_out = split_of(images, eval_every)
    if not train or not held_out:
        raise ValueError(f"{folder}: the split leaves no image to {'evaluate' if train else 'train'}")
    used = sorted({*train, *held_out})
    return used, [used.index(index) for index in train], [used.index(index) for index in held_out]


def with_masks(folder: SceneFolder, images: Sequence[PosedImage]) -> list[PosedImage]:
    """The images with the masks that lie in the folder `masks`, if no image has a mask yet.

    The mask of images/a.jpg is masks/a.jpg.png, masks/a.png or masks/a.jpg; that of images_4/a.jpg is looked for in
    masks_4, too.
    """
    if any(image.mask for image in images):
        return list(images)

    def find(file: Path) -> Mask | None:
        first, _, rest = folder.relative(file).partition("/")
        smaller = [f"{MASKS}_{factor}" for factor in SMALLER if first.endswith(f"_{factor}")]
        for place in filter(lambda place: (folder.path / place).is_dir(), (*smaller, MASKS)):
            for name in (rest, f"{first}/{rest}") if rest else (first,):
                if path := folder.image(f"{place}/{name}") or folder.image(f"{place}/{posixpath.splitext(name)[0]}"):
                    return Mask(path)
        return None

    return [replace(image, mask=find(image.file)) for image in images if image.file is not None]


def scaled(scales: NDArray) -> Iterator[str]:
    """A remark on rotations that were multiplied by a number."""
    low, high = f"{scales.min():.4g}", f"{scales.max():.4g}"
    if max(abs(scales - 1)) > 1e-3:
        yield f"rotations times {low if low == high else f'{low} to {high}'} were divided by it"


def outlying(images: Sequence[PosedImage]) -> Iterator[str]:
    """A remark on views that stand so far from all others that they do not decide the scale."""
    out = far_out(np.array([image.matrix[:3, 3] for image in images]))
    names = [f"{image.name} {times:,.0f} times" for image, times in zip(images, out, strict=True) if times]
    if names:
        far = f"farther out than all others: {shortened(names)}; the scale is that of the others"
        yield f"{far}; if such a pose is wrong, take it out of the file of poses"


def upright(lenses: Sequence[Mapping[str, float]], files: Sequence[ImageFile]) -> Iterator[str]:
    """A remark on upright images whose only focal length is an angle across their shorter side."""
    alone = [lens.keys() & set(FOCAL) == {"camera_angle_x"} for lens in lenses]
    if any(only and file.height > file.width for only, file in zip(alone, files, strict=True)):
        told = "camera_angle_x (or x_fov) is taken across the width, the shorter side"
        yield f"{told}; if it is that of the longer side, as Blender's, call it camera_angle_y (or y_fov)"


def unread(capture: Capture, posed: Sequence[PosedImage], views: Sequence[PosedImage]) -> Iterator[str]:
    """Remarks on images that are not used, and on what else lies in the folder."""
    root = capture.folder.path
    files = {image.file for image in posed if image.file is not None}
    if len(views) < len(posed):
        yield f"{len(posed) - len(views)} posed images not used"
    if len(posed) < len(capture.images):
        yield f"{len(capture.images) - len(posed)} missing images left out"
    without = sum(path not in files for place in {file.parent for file in files} for path in photographs(place))
    without -= sum(
        image.mask is not None and image.mask.file.parent in {file.parent for file in files} for image in views
    )
    if without > 0:
        yield f"{without} images without a pose"
    masks = {image.mask.file for image in views if image.mask is not None}
    tops = {capture.folder.relative(path).split("/")[0] for path in (*files, *masks)} | set(capture.read)
    if "transforms.json" in tops:
        tops.add("sparse")  # `qnerf capture` writes both, for two kinds of scenes
    stems = {top.split("_")[0] for top in tops}
    others = sorted(
        f"{path.name}/" if path.is_dir() else path.name
        for path in root.iterdir()
        if path.name not in tops and path.name[0] != "." and path.name.rpartition("_")[0] not in stems
    )
    if others:
        yield f"files not read: {shortened(others)}"


def shortened(names: Sequence[str]) -> str:
    """The first of the names, and how many there are more."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more


def fingerprint(
    name: str,
    images: Sequence[PosedImage],
    views: Sequence[Mapping[str, Any]],
    train: Sequence[int],
    held_out: Sequence[int],
    width: int | None = None,
) -> str:
    """A hash of what the scene is read from. Nothing in it was computed, so every machine finds the same.

    Args:
        name: of the scene reader.
        images: those over which the world is normalised.
        views: of each view, its index into `images`, its image, the hash of the image file, and the numbers that
            decide its intrinsics, as written; the hash of its mask if it has one.
        train, held_out: indices into `views`.
    """
    content = {
        "reader": name,
        "matrices": [image.matrix[:3].tolist() for image in images],
        "views": views,
        "train": train,
        "held_out": held_out,
        "downscale": 1,  # an option that is gone
    } | ({} if width is None else {"width": width})
    return digest("scene", FINGERPRINT, json.dumps(content, sort_keys=True, allow_nan=False))
