"""Paths of a virtual camera through a scene: around what the cameras look at, or along them.

A path is made from the camera-to-world poses (V, 3, 4) of the training views, in the normalised world with +z up.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, Slerp

from qnerf.geometry.bounds import focus
from qnerf.geometry.rays import rays_from
from qnerf.scenes.base import Cameras
from qnerf.types import Rays

MAX_GAP = math.pi / 2  # radians without a camera, beyond which an orbit goes back and forth
NEARBY = math.radians(20)  # standard deviation of the weights of cameras around a direction
KEY_VIEWS = 12  # which a path interpolates


@dataclass(frozen=True)
class Camera:
    """A pinhole camera whose principal point is the middle of its picture.

    pose: (3, 4), camera-to-world, OpenGL's axes, world units; `look_at` makes one. focal, width, height: pixels.
    """

    pose: NDArray
    focal: float
    width: int
    height: int

    def __post_init__(self) -> None:
        if np.shape(self.pose) != (3, 4):
            raise ValueError(f"pose: expected 3 x 4 numbers, camera to world, got shape {np.shape(self.pose)}")
        if min(self.focal, self.width, self.height) <= 0:
            raise ValueError(
                f"expected a positive focal length and size, got {self.focal}, {self.width}, {self.height}"
            )

    def scaled(self, width: int) -> "Camera":
        """The same view with another number of pixels."""
        height = max(1, round(self.height * width / self.width))
        return replace(self, focal=self.focal * width / self.width, width=width, height=height)

    def rays(
        self,
        pixels: slice,
        near: float,
        far: float,
        *,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> Rays:
        """Rays through the centres of a part of the pixels, which are numbered row by row. They belong to no view, so
        `cameras` is -1.

        >>> camera = Camera(np.eye(4)[:3], 10.0, 3, 1)
        >>> camera.rays(slice(1, 2), 0.1, 5.0).directions.tolist()
        [[0.0, 0.0, -1.0]]
        """
        numbers = torch.arange(*pixels.indices(self.width * self.height), device=device)
        x = (numbers % self.width + 0.5 - self.width / 2) / self.focal
        y = (torch.div(numbers, self.width, rounding_mode="floor") + 0.5 - self.height / 2) / self.focal
        directions = torch.nn.functional.normalize(torch.stack([x, -y, -torch.ones_like(x)], dim=-1), dim=-1)
        poses = torch.as_tensor(self.pose, device=device, dtype=dtype).expand(len(numbers), 3, 4)
        return rays_from(directions.to(dtype) + 0.0, poses, torch.full_like(numbers, -1), near, far)


def look_at(centre: ArrayLike, target: ArrayLike, up: ArrayLike) -> NDArray:
    """The pose (3, 4) of a camera at `centre` that looks at `target`, with `up` upwards in its picture."""
    centre, target, up = (np.asarray(one, np.float64) for one in (centre, target, up))
    backward = (centre - target) / np.linalg.norm(centre - target)
    right = np.cross(up, backward)
    if np.linalg.norm(right) < 1e-6:  # it looks straight up or down
        right = np.cross(np.roll(up, 1), backward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(backward, right), backward, centre], axis=1)


def orbit(poses: NDArray, frames: int) -> NDArray:
    """Around the point that the cameras look at, at the mean distance and height of the cameras in that direction.

    All the way around if there are cameras all around, else back and forth over the angles where there are any.

    Raises:
        ValueError: the cameras look at no common point.
    """
    target = focus(poses)
    if target is None:
        raise ValueError("path=orbit: the cameras look at no common point to go around; use interpolate or spiral")
    x, y, z = (poses[:, :, 3] - target).T
    bearing = np.arctan2(y, x)
    azimuth = np.sort(bearing)
    gaps = np.diff(azimuth, append=azimuth[0] + 2 * np.pi)
    widest = int(gaps.argmax())
    time = np.arange(frames) / frames
    if gaps[widest] < MAX_GAP:
        angles = azimuth[0] + 2 * np.pi * time
    else:
        arc = 2 * np.pi - gaps[widest]
        angles = azimuth[(widest + 1) % len(azimuth)] + arc * (1 - np.cos(2 * np.pi * time)) / 2
    beside = np.angle(np.exp(1j * (angles[:, None] - bearing)))
    share = np.exp(-((beside / NEARBY) ** 2) / 2)
    share /= share.sum(1, keepdims=True)
    radius, height = share @ np.hypot(x, y), share @ z
    centres = target + np.stack([radius * np.cos(angles), radius * np.sin(angles), height], axis=1)
    return np.stack([look_at(centre, target, np.array([0.0, 0, 1])) for centre in centres])


def spiral(poses: NDArray, frames: int) -> NDArray:
    """Two turns around the most central camera, as wide as 90 % of the cameras stand, looking at one point.

    The turns are limited to a quarter of the distance to that point. It is the usual path of forward-facing captures
    (Mildenhall et al. 2019, arXiv:1905.00889).
    """
    centres = poses[:, :, 3]
    apart = np.linalg.norm(centres - centres.mean(0), axis=1) + 1 + (poses[:, :, 2] * -poses[:, :, 2].mean(0)).sum(1)
    base = poses[int(apart.argmin())]
    target = focus(poses)
    distance = 1.0 if target is None else max(float((base[:, 3] - target) @ base[:, 2]), 0.1)
    radii = np.percentile(np.abs((centres - base[:, 3]) @ base[:, :3]), 90, axis=0)
    radii = np.minimum(np.maximum(radii, distance / 50), distance / 4)
    angle = 4 * np.pi * np.arange(frames) / frames
    inside = np.stack([np.cos(angle), -np.sin(angle), -np.sin(angle / 2)], axis=1) * radii
    ahead = base[:, 3] - distance * base[:, 2]
    return np.stack([look_at(base[:, 3] + base[:, :3] @ offset, ahead, base[:, 1]) for offset in inside])


def interpolate(poses: NDArray, frames: int) -> NDArray:
    """Through evenly spread cameras, at even speed; in their order, or from neighbour to neighbour if that is shorter.

    A radian of turning counts as much as the median distance between the cameras and their middle.
    """
    if len(poses) < 2:
        raise ValueError("path=interpolate: expected at least two training cameras, got one; known for one: spiral")
    chosen = poses[np.linspace(0, len(poses) - 1, min(KEY_VIEWS, len(poses))).astype(int)]
    size = float(np.median(np.linalg.norm(poses[:, :, 3] - poses[:, :, 3].mean(0), axis=1)))
    turns = Rotation.from_matrix(chosen[:, :, :3])
    angle = np.stack([(turn.inv() * turns).magnitude() for turn in turns])
    apart = np.linalg.norm(chosen[:, None, :, 3] - chosen[None, :, :, 3], axis=-1) + size * angle
    order = min((list(range(len(chosen))), _neighbours(apart)), key=lambda order: apart[order[:-1], order[1:]].sum())
    steps = np.maximum(apart[order[:-1], order[1:]], 1e-9)
    time = np.concatenate([[0.0], np.cumsum(steps)])
    at = np.linspace(0, time[-1], frames)
    centres = PchipInterpolator(time, chosen[order][:, :, 3])(at)
    return np.concatenate([Slerp(time, turns[order])(at).as_matrix(), centres[:, :, None]], axis=2)


def _neighbours(apart: NDArray) -> list[int]:
    """Each item once, from the first one always on to the nearest that is left."""
    order, left = [0], set(range(1, len(apart)))
    while left:
        order.append(min(left, key=lambda item: apart[order[-1], item]))
        left.remove(order[-1])
    return order


PATHS: dict[str, Callable[[NDArray, int], NDArray]] = {"orbit": orbit, "spiral": spiral, "interpolate": interpolate}
"""Name -> function of the training poses (V, 3, 4) and a number of frames F that returns poses (F, 3, 4)."""


def focal_as(cameras: Cameras, view: int, width: int, height: int) -> float:
    """The focal length in pixels with which a picture covers as much of the image plane as the view."""
    own_width, own_height = cameras.size(view)
    return math.sqrt(float(cameras.fx[view] * cameras.fy[view]) * width * height / (own_width * own_height))
