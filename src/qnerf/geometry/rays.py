"""Pixels -> rays, and the training pixels with their rays ready to be drawn from.

A pixel's direction in the camera's own frame depends on the lens alone. It is computed once for every pixel centre, so
that a training step turns it by the pose, refined or not, and undoes no distortion.
"""

import torch
from torch import Tensor

from qnerf.geometry.pose_refinement import PoseRefinement
from qnerf.scenes.base import Cameras, Scene
from qnerf.scenes.lens import distort, undistort
from qnerf.types import Rays

MOST_DIRECTIONS = 2**24  # kept in a table; beyond, directions are computed for each batch


def camera_directions(cameras: Cameras, views: Tensor, pixels: Tensor) -> Tensor:
    """Unit directions (R, 3) float64 in the camera's frame.

    Args:
        views: (R,) int64.
        pixels: (R, 2) x and y in pixels, continuous: the centre of the first pixel is (0.5, 0.5).
    """
    return _directions(cameras.intrinsics[views.to(cameras.poses.device)], pixels)


def _directions(intrinsics: Tensor, pixels: Tensor) -> Tensor:
    points = (pixels.to(intrinsics) - intrinsics[..., 2:4]) / intrinsics[..., :2]
    points = undistort(points, intrinsics[..., 4:])
    directions = torch.cat([points[..., :1], -points[..., 1:], -torch.ones_like(points[..., :1])], dim=-1)
    return directions / torch.linalg.vector_norm(directions, dim=-1, keepdim=True)


def project(cameras: Cameras, views: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """World points (R, 3) -> where the views (R,) see them: pixels (R, 2) with distortion, and depth along -z (R,).

    Pixels mean nothing where the depth is not above 0.
    """
    poses, intrinsics = cameras.poses[views], cameras.intrinsics[views]
    local = ((points.to(poses) - poses[:, :, 3])[:, :, None] * poses[:, :, :3]).sum(1)
    depth = -local[:, 2]
    plane = torch.stack([local[:, 0], -local[:, 1]], dim=1) / depth[:, None]
    return distort(plane, intrinsics[:, 4:]) * intrinsics[:, :2] + intrinsics[:, 2:4], depth


def rays_from(directions: Tensor, poses: Tensor, views: Tensor, near: float, far: float) -> Rays:
    """Rays in the dtype of `poses`, which they are differentiable in.

    Args:
        directions: (R, 3) unit, in the camera's frame.
        poses: (R, 3, 4) camera-to-world.
        views: (R,) int64.
        near, far: world units.
    """
    turned = (poses[:, :, :3] * directions[:, None, :]).sum(-1)
    bounds = (poses.new_tensor([value]).expand(len(views), 1) for value in (near, far))
    return Rays(poses[:, :, 3], turned, views, *bounds)


def camera_rays(
    cameras: Cameras, views: Tensor, pixels: Tensor, near: float, far: float, dtype: torch.dtype = torch.float32
) -> Rays:
    """Rays of any views (R,) int64 through any points of their images (R, 2), in pixels."""
    directions = camera_directions(cameras, views, pixels)
    return rays_from(directions.to(dtype), cameras.poses[views].to(dtype), views, near, far)


class RayTable:
    """All pixels of a scene with their rays.

    Args:
        scene: whose training views are drawn from.
        near, far: world units; where the scene has bounds of its own, the narrower ones hold.
        device: where rays and pixels are put.
        dtype: of rays and colours.
        apart: one in `apart` training pixels is never drawn for training, and serves validation; 0: none.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        near: float = 0.05,
        far: float = 1000.0,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
        apart: int = 0,
    ) -> None:
        cameras = scene.cameras
        self.near = near if scene.near is None else max(near, scene.near)
        self.far = far if scene.far is None else min(far, scene.far)
        self.apart = apart
        if apart > len(scene.train) * cameras.width * cameras.height:
            raise ValueError(
                f"stop.share keeps one training pixel in {apart} apart, which is none here; make it larger"
            )
        if not 0 <= self.near < self.far:
            raise ValueError(
                f"scene {scene.name}: near must be at least 0 and below far, got {self.near:g} and {self.far:g}"
            )
        self.device, self.dtype = torch.device(device), dtype
        self.width, self.height = cameras.width, cameras.height
        self.pixels = cameras.width * cameras.height  # of one view
        self.poses = cameras.poses.to(self.device, dtype)
        self.colors = scene.images.reshape(-1, scene.images.shape[-1]).to(self.device)
        self.train = torch.tensor(scene.train, dtype=torch.int64)
        lenses, self.lens = torch.unique(cameras.intrinsics, dim=0, return_inverse=True)
        self.lens, self.lenses = self.lens.to(self.device), lenses.to(self.device)
        self.table: Tensor | None = None  # (lenses * H * W, 3)
        if len(lenses) * self.pixels <= MOST_DIRECTIONS:
            every = torch.arange(self.pixels, device=self.device)
            self.table = torch.cat([_directions(lens, self._centres(every)).to(dtype) for lens in self.lenses])

    def _centres(self, pixels: Tensor) -> Tensor:
        """Row-major pixel numbers (R,) -> centres (R, 2), float64."""
        x, y = pixels % self.width, torch.div(pixels, self.width, rounding_mode="floor")
        return torch.stack([x, y], dim=-1).to(torch.float64) + 0.5

    def rays(self, views: Tensor, pixels: Tensor, refinement: PoseRefinement | None = None) -> Rays:
        """Rays through pixel centres: views (R,) and row-major pixel numbers (R,), both int64."""
        lens = self.lens[views]
        if self.table is None:
            directions = _directions(self.lenses[lens], self._centres(pixels)).to(self.dtype)
        else:
            directions = self.table[lens * self.pixels + pixels]
        poses = self.poses[views]
        if refinement is not None:
            poses = refinement.poses(views, poses)
        return rays_from(directions, poses, views, self.near, self.far)

    def batch(
        self, rays: int, generator: torch.Generator, refinement: PoseRefinement | None = None
    ) -> tuple[Rays, Tensor]:
        """`rays` training pixels drawn uniformly, with replacement: their rays and colours (R, 3 or 4) in [0, 1].

        `generator` is one of the CPU, whatever the device: every device sees the same batches.
        """
        total = len(self.train) * self.pixels
        if not self.apart:
            drawn = torch.randint(total, (rays,), generator=generator)
        else:  # every `apart`-th pixel is passed over
            drawn = torch.randint(total - total // self.apart, (rays,), generator=generator)
            drawn += drawn // (self.apart - 1)
        return self._drawn(drawn, refinement)

    def validation(self, rays: int, refinement: PoseRefinement | None = None) -> tuple[Rays, Tensor]:
        """At most `rays` of the training pixels kept apart, evenly spread: their rays and colours."""
        assert self.apart, "no pixels are kept apart"
        kept = torch.arange(self.apart - 1, len(self.train) * self.pixels, self.apart)
        chosen = torch.linspace(0, len(kept) - 1, min(rays, len(kept)), dtype=torch.float64).long()
        return self._drawn(kept[chosen], refinement)

    def _drawn(self, drawn: Tensor, refinement: PoseRefinement | None) -> tuple[Rays, Tensor]:
        """Rays and colours of training pixels (R,), numbered view by view and row by row."""
        views = self.train[torch.div(drawn, self.pixels, rounding_mode="floor")]
        pixels = drawn % self.pixels
        if self.device.type != "cpu":
            views, pixels = views.to(self.device), pixels.to(self.device)
        colors = self.colors[views * self.pixels + pixels].to(self.dtype) / 255
        return self.rays(views, pixels, refinement), colors

    def view(self, view: int, refinement: PoseRefinement | None = None) -> Rays:
        """All H * W rays of a view, row by row."""
        pixels = torch.arange(self.pixels, device=self.device)
        return self.rays(torch.full_like(pixels, view), pixels, refinement)
