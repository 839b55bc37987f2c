"""Pose refinement: a small rigid motion for each training view, learnt with the field.

The motion (Ra, ta) acts in the camera's own frame, on the right of the camera-to-world pose: [R | t] becomes
[R Ra | R ta + t]. It is the exponential of six numbers a view, translation first, which start at zero; it is computed
anew from them each time, so that it stays a rotation however many steps are taken.
"""

import torch
from torch import Tensor, nn

from qnerf.config.checks import at_least
from qnerf.config.registry import Registry

CAMERAS: "Registry[PoseRefinement]" = Registry("cameras")

# (theta - sin theta) / theta^3 as a series in theta^2
_SERIES = [1 / 6, -1 / 120, 1 / 5040, -1 / 362880, 1 / 39916800, -1 / 6227020800, 1 / 1307674368000]


def sinc_of_square(square: Tensor) -> Tensor:
    """sin(theta) / theta from theta^2 >= 0; smooth at 0, gradient included."""
    small = square < 1e-3
    theta = torch.where(small, torch.ones_like(square), square).sqrt()
    near = torch.where(small, square, 0)  # the series overflows at 3e6 radians, and infinity times 0 is no gradient
    series = 1 - near / 6 * (1 - near / 20 * (1 - near / 42))
    return torch.where(small, series, theta.sin() / theta)


def skew(vector: Tensor) -> Tensor:
    """(..., 3) -> (..., 3, 3), the matrix of the cross product with it."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).view(*vector.shape, 3)


def exp_so3(rotation: Tensor) -> Tensor:
    """Rotation vectors (..., 3), radians, of any length whose square is finite -> rotation matrices (..., 3, 3).

    R = I + sin(theta)/theta K + (1 - cos(theta))/theta^2 K^2, the last factor as half the square of
    sin(theta/2) / (theta/2): no digits are lost at small angles or near pi.
    """
    square = rotation.square().sum(-1)[..., None, None]
    k = skew(rotation)
    eye = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
    return eye + sinc_of_square(square) * k + 0.5 * sinc_of_square(square / 4).square() * (k @ k)


def _left_jacobian(rotation: Tensor) -> Tensor:
    """V = I + (1 - cos(theta))/theta^2 K + (theta - sin(theta))/theta^3 K^2: translation part of a twist."""
    square = rotation.square().sum(-1)[..., None, None]
    k = skew(rotation)
    small = square < 1
    series = torch.full_like(square, _SERIES[-1])
    for coefficient in reversed(_SERIES[:-1]):
        series = series * torch.where(small, square, 0) + coefficient
    large = torch.where(small, torch.ones_like(square), square)
    cubic = torch.where(small, series, (1 - sinc_of_square(large)) / large)
    eye = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
    return eye + 0.5 * sinc_of_square(square / 4).square() * k + cubic * (k @ k)


def exp_se3(motion: Tensor) -> Tensor:
    """Twists (..., 6), translation part first, then the rotation vector -> rigid motions (..., 3, 4)."""
    rotation = motion[..., 3:]
    return torch.cat([exp_so3(rotation), _left_jacobian(rotation) @ motion[..., :3, None]], dim=-1)


def exp_so3xr3(motion: Tensor) -> Tensor:
    """Translation and rotation vector (..., 6) -> rigid motions (..., 3, 4)."""
    return torch.cat([exp_so3(motion[..., 3:]), motion[..., :3, None]], dim=-1)


class PoseRefinement(nn.Module):
    """Refines the poses of training views.

    Args:
        views: number of views of the scene.
        trained: those that are refined; None for all. The others, and a view of -1, keep their poses.
    """

    def __init__(self, views: int, trained: list[int] | None = None) -> None:
        super().__init__()

    def poses(self, indices: Tensor, poses: Tensor) -> Tensor:
        """Views (R,) int64 and their camera-to-world poses (R, 3, 4) -> refined poses (R, 3, 4)."""
        raise NotImplementedError

    def penalty(self) -> Tensor | None:
        """What training adds to the loss; None where there is nothing to add."""
        raise NotImplementedError


@CAMERAS.register("fixed")
class FixedPoses(PoseRefinement):
    """Poses as they are given."""

    def poses(self, indices: Tensor, poses: Tensor) -> Tensor:
        return poses

    def penalty(self) -> None:
        return None


class RefinedPoses(PoseRefinement):
    """Six numbers a trained view, `motion` (trained views, 6): translation in world units, then rotation in radians."""

    rows: Tensor

    def __init__(
        self,
        views: int,
        trained: list[int] | None = None,
        *,
        translation_penalty: float = 1e-2,
        rotation_penalty: float = 1e-3,
    ) -> None:
        super().__init__(views, trained)
        for name, value in (("translation_penalty", translation_penalty), ("rotation_penalty", rotation_penalty)):
            at_least(name, value, 0)
        self.translation_penalty, self.rotation_penalty = translation_penalty, rotation_penalty
        chosen = list(range(views)) if trained is None else trained
        rows = torch.full((views + 1,), -1)  # the last one answers for view -1
        rows[chosen] = torch.arange(len(chosen))
        self.register_buffer("rows", rows, persistent=False)
        self.motion = nn.Parameter(torch.zeros(len(chosen), 6))

    @staticmethod
    def exponential(motion: Tensor) -> Tensor:
        raise NotImplementedError

    def poses(self, indices: Tensor, poses: Tensor) -> Tensor:
        motion = nn.functional.pad(self.motion, (0, 0, 0, 1))[self.rows[indices]]
        moved = self.exponential(motion)
        rotation = poses[..., :3]
        turned = rotation @ moved
        return torch.cat([turned[..., :3], turned[..., 3:] + poses[..., 3:]], dim=-1)

    def penalty(self) -> Tensor:
        """Mean over trained views of 1e-2 |translation| + 1e-3 |rotation vector| (the defaults)."""
        lengths = torch.linalg.vector_norm(self.motion.view(-1, 2, 3), dim=-1).mean(0)
        return self.translation_penalty * lengths[0] + self.rotation_penalty * lengths[1]


@CAMERAS.register("so3xr3")
class SO3xR3Refinement(RefinedPoses):
    """A rotation vector and a translation, which do not act on each other."""

    exponential = staticmethod(exp_so3xr3)


@CAMERAS.register("se3")
class SE3Refinement(RefinedPoses):
    """A twist: the translation is carried along the rotation."""

    exponential = staticmethod(exp_se3)
