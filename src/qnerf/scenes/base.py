"""`Scene` and `Cameras`: posed images, independent of the format that they were read from."""

import hashlib
import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from qnerf.config.registry import Registry

MIN_VIEWS = 3


@dataclass(frozen=True, eq=False)
class Cameras:
    """V calibrated views of one image size.

    Axes are OpenGL's: +x right, +y up, the camera looks along -z. Pixel coordinates have x to the right and y down;
    the centre of the first pixel is (0.5, 0.5). The lens is OpenCV's with `k1 k2 p1 p2` (`qnerf.scenes.lens`).
    """

    poses: Tensor  # (V, 3, 4) float64, camera-to-world: rotation | centre in world units
    fx: Tensor  # (V,) float64, focal length in pixels; so is fy
    fy: Tensor
    cx: Tensor  # (V,) float64, principal point in pixels; so is cy
    cy: Tensor
    distortion: Tensor  # (V, 4) float64: k1 k2 p1 p2, no unit
    width: int  # pixels
    height: int

    def __len__(self) -> int:
        return self.poses.shape[0]

    @classmethod
    def from_arrays(cls, poses: NDArray, intrinsics: NDArray, width: int, height: int) -> "Cameras":
        """From poses (V, 3, 4) and intrinsics (V, 8): fx fy cx cy k1 k2 p1 p2."""
        columns = torch.from_numpy(intrinsics.astype(np.float64))
        fx, fy, cx, cy = (column.clone() for column in columns[:, :4].unbind(1))
        return cls(torch.from_numpy(poses), fx, fy, cx, cy, columns[:, 4:].clone(), width, height)

    @property
    def intrinsics(self) -> Tensor:
        """(V, 8): fx fy cx cy k1 k2 p1 p2."""
        return torch.cat([torch.stack([self.fx, self.fy, self.cx, self.cy], dim=1), self.distortion], dim=1)


@dataclass(frozen=True, eq=False)
class Scene:
    """Images, their cameras, and the split into training views and held-out views."""

    name: str
    images: Tensor  # (V, H, W, 3 or 4) uint8, sRGB; a fourth channel is straight alpha
    cameras: Cameras
    train: list[int]  # indices of views
    eval: list[int]
    names: list[str]  # of the views: image files relative to the scene's folder
    fingerprint: str  # hash of what the scene is made from; the same in every folder and on every machine
    transform: Tensor  # (4, 4) float64 similarity: the source's world -> normalised world
    depth: Tensor | None = None  # (V, H, W) float32, distance along the ray of the pixel's centre; inf: nothing hit
    near: float | None = None  # world units; None: the scene defines no bounds
    far: float | None = None
    older_fingerprint: str | None = None  # of the same contents, in the ids of older runs; None: the same
    headline: ClassVar[str] = "psnr"  # key of the metric that is shown during training

    @property
    def fingerprints(self) -> list[str]:
        """Those that the id of a run of this scene may hold, today's first."""
        return [self.fingerprint, *([self.older_fingerprint] if self.older_fingerprint else [])]

    @property
    def has_alpha(self) -> bool:
        return self.images.shape[-1] == 4

    def colors(self, view: int, background: float | Tensor) -> Tensor:
        """The view (H, W, 3) float32 in [0, 1], composited over a grey value or a colour (3,) in [0, 1]."""
        return composite(self.images[view].to(torch.float32) / 255, background)


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


def split_views(views: int) -> tuple[list[int], list[int]]:
    """Indices of training and evaluation views: 90 % train, evenly spread, and at least one view evaluates.

    Training views are int(linspace(0, V - 1, ceil(0.9 V))), as in nerfstudio.

    >>> split_views(10)
    ([0, 1, 2, 3, 4, 5, 6, 7, 9], [8])
    """
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
