"""What a scene is, whatever it was read from."""

import hashlib
import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from qnerf.config.registry import Registry

LEAST_VIEWS = 3


@dataclass(frozen=True, eq=False)
class Cameras:
    """V calibrated views of one image size.

    Axes are OpenGL's: +x right, +y up, the camera looks along -z. Pixel (0, 0) covers [0, 1) x [0, 1) with x to the
    right and y down, so that its centre is (0.5, 0.5). The lens is OpenCV's with `k1 k2 p1 p2`.
    """

    poses: Tensor  # (V, 3, 4) float64, camera-to-world, rotation | centre in world units
    fx: Tensor  # (V,) float64, pixels; so are fy, cx, cy
    fy: Tensor
    cx: Tensor
    cy: Tensor
    distortion: Tensor  # (V, 4) float64, k1 k2 p1 p2 without unit
    width: int  # pixels
    height: int

    def __len__(self) -> int:
        return self.poses.shape[0]

    @property
    def intrinsics(self) -> Tensor:
        """(V, 8): fx fy cx cy k1 k2 p1 p2."""
        return torch.cat([torch.stack([self.fx, self.fy, self.cx, self.cy], dim=1), self.distortion], dim=1)


@dataclass(frozen=True, eq=False)
class Scene:
    """Images, their cameras, and which views train and which are held out."""

    name: str
    images: Tensor  # (V, H, W, 3 or 4) uint8, sRGB; straight alpha where there are 4 channels
    cameras: Cameras
    train: list[int]
    eval: list[int]
    names: list[str]  # of the views: image files relative to the scene's folder
    fingerprint: str  # hash of images, poses, intrinsics and split; the same wherever the scene lies
    transform: Tensor  # (4, 4) float64 similarity: the source's world -> normalised world
    depth: Tensor | None = None  # (V, H, W) float32, distance along the pixel centre's unit ray; inf: nothing hit
    near: float | None = None  # world units; None: the scene has no bounds of its own
    far: float | None = None

    def colors(self, view: int, background: float | Tensor) -> Tensor:
        """The view (H, W, 3) float32 in [0, 1]; alpha composited on `background`, a grey or a colour (3,) in [0, 1]."""
        pixels = self.images[view].to(torch.float32) / 255
        if pixels.shape[-1] == 3:
            return pixels
        alpha = pixels[..., 3:]
        return pixels[..., :3] * alpha + background * (1 - alpha)


SCENES: Registry[Scene] = Registry("scene")


def split_views(views: int) -> tuple[list[int], list[int]]:
    """Nine in ten, evenly spread, train: int(linspace(0, V - 1, ceil(0.9 V))). The others, at least one, evaluate."""
    count = min(math.ceil(0.9 * views), views - 1)
    train = [int(index) for index in np.linspace(0, views - 1, count)]
    return train, sorted(set(range(views)) - set(train))


def digest(*parts: str | bytes | NDArray) -> str:
    """Twenty hexadecimal digits of the SHA-256 of the parts; numbers as little-endian float64."""
    total = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            part = str(part.shape).encode() + part.astype("<f8").tobytes()
        elif isinstance(part, str):
            part = part.encode()
        total.update(hashlib.sha256(part).digest())
    return total.hexdigest()[:20]
