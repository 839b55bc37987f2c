"""Pixels -> rays, and `RayTable`, from which training draws batches of rays and their colours.

A pixel's direction in the camera's frame depends on the lens alone. It is computed once for every pixel centre. A
training step only rotates it by the pose, refined or not, and does not undo lens distortion again.
"""

import numpy as np
import torch
from torch import Tensor

from qnerf.config import memory
from qnerf.config.tensors import returned
from qnerf.geometry.bounds import bounds_of
from qnerf.geometry.pose_refinement import PoseRefinement
from qnerf.scenes.base import Cameras, Scene
from qnerf.scenes.lens import directions, image_points
from qnerf.types import Rays

MAX_TABLE_SIZE = 2**24  # directions in memory; beyond that, they are computed for each batch
PART = 2**18  # directions computed at a time


def camera_directions(cameras: Cameras, views: Tensor, pixels: Tensor) -> Tensor:
    """Unit directions (R, 3) float64 in the camera's frame, lens distortion undone.

    A pinhole ray through the principal point looks along -z:

    >>> one = torch.ones(1, dtype=torch.float64)
    >>> pose, no_distortion = torch.eye(4, dtype=torch.float64)[None, :3], torch.zeros(1, 4, dtype=torch.float64)
    >>> cameras = Cameras(pose, 30 * one, 30 * one, 16 * one, 12 * one, no_distortion, 32, 24)
    >>> camera_directions(cameras, torch.tensor([0]), torch.tensor([[16.0, 12.0]])).tolist()
    [[0.0, -0.0, -1.0]]

    Args:
        views: (R,) int64.
        pixels: (R, 2) continuous x and y in pixels; the centre of the first pixel is (0.5, 0.5).
    """
    views = views.to(cameras.poses.device)
    return _directions(cameras.intrinsics[views], pixels, None if cameras.fisheye is None else cameras.fisheye[views])


def _directions(intrinsics: Tensor, pixels: Tensor, fisheye: Tensor | None) -> Tensor:
    points = (pixels.to(intrinsics) - intrinsics[..., 2:4]) / intrinsics[..., :2]
    return directions(points, intrinsics[..., 4:], fisheye)


def _directions_of_pixels(lens: Tensor, pixels: Tensor) -> Tensor:
    """Of row-major pixel numbers (R,). lens: (11,) or (R, 11), a row of `RayTable.lenses`."""
    width = lens[..., 8].long()
    x, y = pixels % width, torch.div(pixels, width, rounding_mode="floor")
    return _directions(lens[..., :8], torch.stack([x, y], dim=-1).to(torch.float64) + 0.5, lens[..., 10] > 0)


def project(cameras: Cameras, views: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """World points (R, 3) -> their pixels (R, 2) in the views (R,), with lens distortion, and depth along -z (R,).

    Pixels are valid only where the depth is above 0.
    """
    poses, intrinsics = cameras.poses[views], cameras.intrinsics[views]
    fisheye = None if cameras.fisheye is None else cameras.fisheye[views]
    local = ((points.to(poses) - poses[:, :, 3])[:, :, None] * poses[:, :, :3]).sum(1)
    plane = image_points(local, intrinsics[:, 4:], fisheye)
    return plane * intrinsics[:, :2] + intrinsics[:, 2:4], -local[:, 2]


def rays_from(directions: Tensor, poses: Tensor, views: Tensor, near: float, far: float) -> Rays:
    """Rays in the dtype of `poses` and differentiable with respect to them.

    Args:
        directions: (R, 3) unit vectors in the camera's frame.
        poses: (R, 3, 4) camera-to-world.
        views: (R,) int64.
        near, far: world units.
    """
    rotated = (poses[:, :, :3] * directions[:, None, :]).sum(-1)
    bounds = (poses.new_full((), value).expand(len(views), 1) for value in (near, far))
    return Rays(poses[:, :, 3], rotated, views, *bounds)


def camera_rays(
    cameras: Cameras, views: Tensor, pixels: Tensor, near: float, far: float, dtype: torch.dtype = torch.float32
) -> Rays:
    """Rays through the continuous pixels (R, 2) of the views (R,) int64; near and far in world units."""
    directions = camera_directions(cameras, views, pixels)
    return rays_from(directions.to(dtype), cameras.poses[views].to(dtype), views, near, far)


class TrainingPixels:
    """The pixels of the training views, numbered view by view and row by row. Masked ones are left out."""

    def __init__(self, scene: Scene, device: torch.device | str = "cpu") -> None:
        self.views = torch.tensor(scene.train, dtype=torch.int64, device=device)
        masks = [scene.valid(view) for view in scene.train]
        counts = [
            size.prod() if mask is None else mask.sum()
            for size, mask in zip(scene.cameras.all_sizes[scene.train], masks, strict=True)
        ]
        ends = torch.stack(counts).cumsum(0)
        self.count = int(ends[-1])
        self.ends = ends.to(device)  # where the numbers of each view end
        unmasked = [mask.flatten().nonzero()[:, 0].to(torch.int32) for mask in masks if mask is not None]
        self.unmasked = torch.cat(unmasked).to(device) if unmasked else None  # the pixels that the numbers stand for

    def __len__(self) -> int:
        return self.count

    def locate(self, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Numbers (R,) -> views (R,) and row-major pixel numbers within them (R,); all int64."""
        rank = torch.searchsorted(self.ends, numbers, right=True)
        if self.unmasked is not None:
            return self.views[rank], self.unmasked[numbers].long()
        return self.views[rank], numbers - torch.nn.functional.pad(self.ends, (1, 0))[rank]

    def number(self, views: Tensor, pixels: Tensor) -> Tensor:
        """The inverse of `locate`; -1 for pixels that are masked and for views that do not train."""
        rank = torch.full((int(torch.cat([views, self.views]).max()) + 1,), -1)
        rank[self.views] = torch.arange(len(self.views))
        rank = rank[views]
        starts = torch.nn.functional.pad(self.ends, (1, 0))
        if self.unmasked is None:
            return torch.where(rank < 0, -1, starts[rank] + pixels)
        numbers = torch.full_like(pixels, -1)
        for view in rank[rank >= 0].unique().tolist():
            own = (rank == view).nonzero()[:, 0]
            left = self.unmasked[starts[view] : starts[view + 1]].long()
            places = starts[view] + torch.searchsorted(left, pixels[own])
            numbers[own] = torch.where(torch.isin(pixels[own], left), places, -1)
        return numbers


def spread_rays(scene: Scene, count: int) -> Rays:
    """At most `count` training rays in float64, evenly spread over all pixels, from 0 to 1 world units."""
    training = TrainingPixels(scene)
    chosen = np.linspace(0, len(training) - 1, min(count, len(training))).astype(np.int64)
    views, pixel = training.locate(torch.from_numpy(chosen))
    widths = scene.cameras.all_sizes[views, 0]
    centres = torch.stack([pixel % widths, pixel // widths], dim=-1) + 0.5
    return camera_rays(scene.cameras, views, centres, 0.0, 1.0, torch.float64)


def sent(values: Tensor, device: torch.device) -> Tensor:
    """The values (R,) on the device. A copy from pinned memory to a GPU waits for nothing."""
    return values.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else values.to(device)


class RayTable:
    """All pixels of a scene with their rays.

    Args:
        scene: training batches are drawn from its training views.
        near, far: see `bounds_of`.
        device: of rays and colours.
        dtype: of rays and colours.
        validation_stride: every `validation_stride`-th training pixel is held out for validation; 0: none.

    Raises:
        ValueError: near is not below far, or the stride is larger than the number of training pixels.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        near: float | None = None,
        far: float | None = None,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
        validation_stride: int = 0,
    ) -> None:
        self.scene, cameras = scene, scene.cameras
        self.near, self.far = bounds_of(scene, near, far)
        self.validation_stride = validation_stride
        self.training = TrainingPixels(scene, device)
        scene.require_pixels()
        if validation_stride > len(self.training):
            raise ValueError(
                f"stop.share holds out one training pixel in {validation_stride}, which is none here; make it larger"
            )
        self.device, self.dtype, self.cameras = torch.device(device), dtype, cameras
        self.poses = cameras.poses.to(self.device, dtype)
        self.colors = scene.images.reshape(-1, scene.images.shape[-1]).to(self.device)
        counts = cameras.all_sizes.prod(1)
        self.first = (counts.cumsum(0) - counts).to(self.device)  # of each view's pixels in `colors`
        fisheye = torch.zeros(len(cameras)) if cameras.fisheye is None else cameras.fisheye
        kinds = torch.cat([cameras.intrinsics, cameras.all_sizes, fisheye[:, None]], dim=1)
        lenses, lens_of_view = torch.unique(kinds, dim=0, return_inverse=True)
        self.lens_of_view, self.lenses = lens_of_view.to(self.device), lenses.to(self.device)
        sizes = lenses[:, 8:10].long().prod(1)
        self.first_direction = (sizes.cumsum(0) - sizes).to(self.device)  # of each lens in `directions`
        self.directions: Tensor | None = None  # (pixels of all lenses, 3)
        if int(sizes.sum()) <= MAX_TABLE_SIZE:
            self.directions = self._directions_of_all_pixels(scene.name, sizes.tolist())

    def _directions_of_all_pixels(self, scene: str, sizes: list[int]) -> Tensor:
        """Directions (N, 3), lens by lens, computed in parts so that intermediate values stay small."""
        size = sum(sizes)
        if self.device.type == "cpu":
            memory.require(f"scene {scene}: the table of {size:,} rays", 3 * self.dtype.itemsize * size)
        table = torch.empty(size, 3, device=self.device, dtype=self.dtype)
        for lens, rows in zip(self.lenses, table.split(sizes), strict=True):
            for first in range(0, len(rows), PART):
                part = rows[first : first + PART]
                part.copy_(_directions_of_pixels(lens, torch.arange(first, first + len(part), device=self.device)))
        return table

    def rays(self, views: Tensor, pixels: Tensor, refinement: PoseRefinement | None = None) -> Rays:
        """Rays through pixel centres: views (R,) and row-major pixel numbers (R,), both int64."""
        lens = self.lens_of_view[views]
        if self.directions is None:
            directions = _directions_of_pixels(self.lenses[lens], pixels).to(self.dtype)
        else:
            directions = self.directions[self.first_direction[lens] + pixels]
        poses = self.poses[views]
        if refinement is not None:
            poses = returned(refinement, refinement.poses(views, poses), poses.shape, poses)
        return rays_from(directions, poses, views, self.near, self.far)

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Numbers (count,) of training pixels, drawn uniformly with replacement, int64 on the device.

        `generator` is on the CPU, so that all devices see the same pixels.
        """
        stride, total = self.validation_stride, len(self.training)
        held_out = total // stride if stride else 0
        numbers = torch.randint(total - held_out, (count,), generator=generator)
        if stride:  # skip every `stride`-th pixel
            numbers += numbers // (stride - 1)
        return sent(numbers, self.device)

    def batch(self, numbers: Tensor, refinement: PoseRefinement | None = None) -> tuple[Rays, Tensor]:
        """Rays and colours (R, 3 or 4) in [0, 1] of training pixels: numbers (R,) on the device, view by view."""
        views, pixels = self.training.locate(numbers)
        colors = self.colors[self.first[views] + pixels].to(self.dtype) / 255
        return self.rays(views, pixels, refinement), colors

    def validation(self, rays: int, refinement: PoseRefinement | None = None) -> tuple[Rays, Tensor]:
        """Rays and colours of at most `rays` of the held-out training pixels, evenly spread."""
        stride = self.validation_stride
        assert stride, "no pixels are held out"
        held_out = len(self.training) // stride  # their number
        index = torch.linspace(0, held_out - 1, min(rays, held_out), dtype=torch.float64).long()
        return self.batch(sent(stride - 1 + index * stride, self.device), refinement)

    def view(self, view: int, refinement: PoseRefinement | None = None) -> Rays:
        """All H * W rays of a view, row by row."""
        width, height = self.cameras.size(view)
        pixels = torch.arange(width * height, device=self.device)
        return self.rays(torch.full_like(pixels, view), pixels, refinement)
