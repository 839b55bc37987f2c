"""`Scene` and `Cameras`: posed images, independent of the format that they were read from."""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from qnerf.config.registry import Registry
from qnerf.config.tensors import require_tensor

MIN_VIEWS = 3


@dataclass(frozen=True, eq=False)
class Cameras:
    """V calibrated views.

    Axes are OpenGL's: +x right, +y up, the camera looks along -z. Pixel coordinates have x to the right and y down;
    the centre of the first pixel is (0.5, 0.5). The lens is OpenCV's, perspective or fisheye (`qnerf.scenes.lens`).
    """

    poses: Tensor  # (V, 3, 4) float64, camera-to-world: rotation | centre in world units
    fx: Tensor  # (V,) float64, focal length in pixels; so is fy
    fy: Tensor
    cx: Tensor  # (V,) float64, principal point in pixels; so is cy
    cy: Tensor
    distortion: Tensor  # (V, 4) float64, no unit: k1 k2 p1 p2; of a fisheye k1 k2 k3 k4
    width: int  # pixels; of the widest view if sizes differ
    height: int  # of the highest view if sizes differ
    sizes: Tensor | None = None  # (V, 2) int64, width and height of each view; None: all have one size
    fisheye: Tensor | None = None  # (V,) bool: whether the lens is a fisheye; None: none is

    def __post_init__(self) -> None:
        """ValueError unless all values have the shapes above, and those of float64 are finite."""
        shapes = {"poses": ("V", 3, 4), "distortion": (len(self), 4), "sizes": (len(self), 2)}
        for name in ("poses", "fx", "fy", "cx", "cy", "distortion", "sizes", "fisheye"):
            if (values := getattr(self, name)) is not None:
                dtype = {"sizes": torch.int64, "fisheye": torch.bool}.get(name, torch.float64)
                require_tensor(f"Cameras.{name}", values, shapes.get(name, (len(self),)), dtype)
                if not bool(values.isfinite().all()):
                    raise ValueError(f"Cameras.{name}: expected finite numbers, got NaN or infinity")

    def __len__(self) -> int:
        return self.poses.shape[0]

    @classmethod
    def from_arrays(
        cls, poses: NDArray, intrinsics: NDArray, sizes: NDArray, fisheye: NDArray[np.bool_] | None = None
    ) -> "Cameras":
        """From poses (V, 3, 4), intrinsics (V, 8) as `intrinsics` below, and sizes (V, 2) or (2,), width and height."""
        columns = torch.from_numpy(intrinsics.astype(np.float64))
        fx, fy, cx, cy = (column.clone() for column in columns[:, :4].unbind(1))
        each = np.broadcast_to(sizes, (len(poses), 2)).astype(np.int64)
        differ, bent = bool((each != each[0]).any()), fisheye is not None and bool(fisheye.any())
        width, height = each.max(axis=0).tolist()
        cameras = cls(torch.from_numpy(poses), fx, fy, cx, cy, columns[:, 4:].clone(), width, height)
        return replace(
            cameras,
            sizes=torch.from_numpy(each) if differ else None,
            fisheye=torch.from_numpy(fisheye) if bent else None,
        )

    @property
    def intrinsics(self) -> Tensor:
        """(V, 8): fx fy cx cy, and the four numbers of the distortion."""
        return torch.cat([torch.stack([self.fx, self.fy, self.cx, self.cy], dim=1), self.distortion], dim=1)

    @property
    def all_sizes(self) -> Tensor:
        """(V, 2) int64: width and height of each view, pixels."""
        return torch.tensor([[self.width, self.height]]).expand(len(self), 2) if self.sizes is None else self.sizes

    def size(self, view: int) -> tuple[int, int]:
        """Width and height of the view, pixels."""
        width, height = self.all_sizes[view].tolist()
        return width, height

    @property
    def straight(self) -> bool:
        """Whether all lenses are pinholes: straight lines stay straight."""
        return self.fisheye is None and not bool(self.distortion.any())


@dataclass(frozen=True, eq=False)
class Scene:
    """Images, their cameras, and the split into training views and held-out views."""

    name: str
    # (V, H, W, 3 or 4) uint8, sRGB; a fourth channel is straight alpha. Where sizes differ, (P, 3 or 4): all pixels,
    # view after view and row by row.
    images: Tensor
    cameras: Cameras
    train: list[int]  # indices of views
    eval: list[int]
    names: list[str]  # of the views: image files relative to the scene's folder
    fingerprint: str  # hash of what the scene is made from; the same in every folder and on every machine
    transform: Tensor  # (4, 4) float64 similarity: the source's world -> normalised world
    depth: Tensor | None = None  # (V, H, W) float32, distance along the ray of the pixel's centre; inf: nothing hit
    specular: Tensor | None = None  # (V, H, W) uint8: levels by which specular light raises a pixel's brightest channel
    near: float | None = None  # world units; None: the scene defines no bounds
    far: float | None = None
    headline: ClassVar[str] = "psnr"  # key of the metric that is shown during training
    mask: Tensor | None = None  # bool, of the images' shape without channels: False is neither trained on nor measured
    masks: int = 0  # views that have a mask
    points: Tensor | None = None  # (P, 4) float64: a view, and x y z of a sparse point that it sees, normalised world
    remarks: tuple[str, ...] = ()  # what the reader has to say: what it corrected, and what it did not read

    def __post_init__(self) -> None:
        """ValueError unless images, masks, depths, names and the split fit the cameras."""
        of, views = self.cameras, len(self.cameras)
        shape: tuple[int, ...] = (views, of.height, of.width) if of.sizes is None else (int(of.sizes.prod(1).sum()),)
        label = f"scene {self.name}: "
        require_tensor(f"{label}images", self.images, (*shape, 4 if self.has_alpha else 3), torch.uint8)
        if self.mask is not None:
            require_tensor(f"{label}mask", self.mask, shape, torch.bool)
        if self.depth is not None:
            require_tensor(f"{label}depth", self.depth, shape, torch.float32, torch.float64)
        if self.specular is not None:
            require_tensor(f"{label}specular", self.specular, shape, torch.uint8)
        if self.points is not None:
            require_tensor(f"{label}points", self.points, ("P", 4), torch.float64)
        require_tensor(f"{label}transform", self.transform, (4, 4), torch.float64)
        if len(self.names) != views:
            raise ValueError(f"{label}expected a name for each of {views} views, got {len(self.names)}")
        for use, chosen in (("train", self.train), ("eval", self.eval)):
            if not set(chosen) <= set(range(views)):
                raise ValueError(f"{label}{use}: expected indices of views, 0 to {views - 1}, got {str(chosen)[:100]}")

    def description(self) -> str:
        """One line: how many views of which size, how they are split, masks, and the reader's remarks.

        "29 views of 36 x 64 pixels, 27 train, 2 held out, 29 masks (20.8% of the pixels)"
        """
        cameras = self.cameras
        upto = "" if cameras.sizes is None else "up to "
        share = "" if self.mask is None else f" ({1 - float(self.mask.double().mean()):.1%} of the pixels)"
        counts = f"{len(self.train)} train, {len(self.eval)} held out, {self.masks} masks{share}"
        views = f"{len(cameras)} views of {upto}{cameras.width} x {cameras.height} pixels, {counts}"
        return "; ".join([views, *self.remarks])

    def validating(self, share: float) -> "Scene":
        """The scene that holds out validation views instead of its test views, see `hold_out`."""
        train, validation = hold_out(self.train, share)
        remark = f"held out for validation; {len(self.eval)} test views play no part"
        return replace(self, train=train, eval=validation, remarks=(remark, *self.remarks))

    @property
    def has_alpha(self) -> bool:
        return self.images.shape[-1] == 4

    def colors(self, view: int, background: float | Tensor) -> Tensor:
        """The view (H, W, 3) float32 in [0, 1], composited over a grey value or a colour (3,) in [0, 1]."""
        return composite(self.image(view).to(torch.float32) / 255, background)

    def image(self, view: int) -> Tensor:
        """The view's pixels, (H, W, 3 or 4) uint8."""
        return self._of_view(self.images, view)

    def valid(self, view: int) -> Tensor | None:
        """(H, W) bool: the pixels of the view that are not masked; None: the scene has no masks."""
        return None if self.mask is None else self._of_view(self.mask, view)

    def require_pixels(self) -> None:
        """ValueError if the masks leave no pixel of any training view, or of any held-out view."""
        for views, what in ((self.train, "train on"), (self.eval, "measure: all held-out views are masked")):
            if self.mask is not None and not any(bool(self._of_view(self.mask, view).any()) for view in views):
                raise ValueError(f"scene {self.name}: the masks leave no pixel to {what}")

    def _of_view(self, values: Tensor, view: int) -> Tensor:
        if self.cameras.sizes is None:
            return values[view]
        width, height = self.cameras.size(view)
        first = int(self.cameras.sizes[:view].prod(1).sum())
        return values[first : first + width * height].unflatten(0, (height, width))


def composite(pixels: Tensor, background: float | Tensor | None) -> Tensor:
    """Straight-alpha pixels (..., 4) over a grey value or colours (..., 3). Pixels (..., 3) are opaque and returned as
    they are.

    >>> composite(torch.tensor([0.5, 0.0, 1.0, 0.25]), 1.0).tolist()
    [0.875, 0.75, 1.0]
    """
    if pixels.shape[-1] == 3:
        return pixels
    assert background is not None, "images with alpha need a known background"
    alpha = pixels[..., 3:]
    return pixels[..., :3] * alpha + background * (1 - alpha)


SCENES: Registry[Any] = Registry("scene")
"""Name -> what makes a `Scene`, or a signal (`qnerf.signals`)."""


def even_subset(items: int, limit: int | None) -> list[int]:
    """At most `limit` of range(items), evenly spread; None: all.

    >>> even_subset(9, 3)
    [1, 4, 7]
    """
    if limit is None or limit >= items:
        return list(range(items))
    return [int((2 * index + 1) * items / (2 * limit)) for index in range(limit)]


def hold_out(train: Sequence[int], share: float) -> tuple[list[int], list[int]]:
    """What trains, split into what still trains and what validates: a share of it, evenly spread, and at least one.

    >>> hold_out([0, 1, 2, 4, 5], 0.4)
    ([0, 2, 5], [1, 4])

    ValueError where nothing is left to train on.
    """
    chosen = set(even_subset(len(train), max(1, round(share * len(train)))))
    if len(chosen) == len(train):
        raise ValueError(f"scene.validation={share:g}: leaves nothing to train on, of {len(train)} training views")
    kept = [index for place, index in enumerate(train) if place not in chosen]
    return kept, [train[place] for place in sorted(chosen)]


def split_views(views: int, every: int | None = None) -> tuple[list[int], list[int]]:
    """Indices of training and evaluation views: 90 % train, evenly spread, and at least one view evaluates.

    Training views are int(linspace(0, V - 1, ceil(0.9 V))), as in nerfstudio.

    every: instead, one of `every` views evaluates, beginning with the first, as in LLFF.

    >>> split_views(10)
    ([0, 1, 2, 3, 4, 5, 6, 7, 9], [8])
    >>> split_views(7, every=3)
    ([1, 2, 4, 5], [0, 3, 6])
    """
    if every is not None:
        return [view for view in range(views) if view % every], list(range(0, views, every))
    count = min(math.ceil(0.9 * views), views - 1)
    train = [int(index) for index in np.linspace(0, views - 1, count)]
    return train, sorted(set(range(views)) - set(train))


def digest(*parts: str | bytes | NDArray) -> str:
    """The first 20 hexadecimal digits of a SHA-256 over all parts. Arrays are hashed as little-endian float64."""
    total = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            part = str(part.shape).encode() + part.astype("<f8").tobytes()
        elif isinstance(part, str):
            part = part.encode()
        total.update(hashlib.sha256(part).digest())
    return total.hexdigest()[:20]
