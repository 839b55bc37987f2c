"""Pose refinement: a small rigid motion for each training view, learnt with the field (arXiv:2104.06405).

The motion [Ra | ta] acts in the camera's own frame: the camera-to-world pose [R | t] becomes [R Ra | R ta + t]. It is
the exponential of six parameters per view, which start at 0. Computing it anew in each step keeps it an exact rotation.
"""

from typing import ClassVar

import torch
from torch import Tensor, nn

from qnerf.config.bounds import NonNegativeFactor
from qnerf.config.registry import Registry
from qnerf.geometry.rotations import exp_se3, exp_so3xr3

CAMERAS: "Registry[PoseRefinement]" = Registry("cameras")


class PoseRefinement(nn.Module):
    """Refines the poses of training views.

    Args:
        views: number of views of the scene.
        trained: indices of the views that are refined; None: all. The others, and view -1, keep their poses.
    """

    trainable: ClassVar[bool] = True
    """Whether it has parameters; where not, no learning rate acts on it."""

    def __init__(self, views: int, trained: list[int] | None = None) -> None:
        super().__init__()

    def poses(self, indices: Tensor, poses: Tensor) -> Tensor:
        """Views (R,) int64 and their camera-to-world poses (R, 3, 4) -> refined poses (R, 3, 4)."""
        raise NotImplementedError

    def penalty(self) -> Tensor | None:
        """A scalar loss term that keeps the motions small; None: no term."""
        raise NotImplementedError


@CAMERAS.register("fixed")
class FixedPoses(PoseRefinement):
    """No refinement."""

    trainable = False

    def poses(self, indices: Tensor, poses: Tensor) -> Tensor:
        return poses

    def penalty(self) -> None:
        return None


class RefinedPoses(PoseRefinement):
    """The parameter `motion` (trained views, 6): a translation in world units, then a rotation vector in radians.

    Args:
        translation_penalty, rotation_penalty: weights of the mean lengths in `penalty`.
    """

    rows: Tensor

    def __init__(
        self,
        views: int,
        trained: list[int] | None = None,
        *,
        translation_penalty: NonNegativeFactor = 1e-2,
        rotation_penalty: NonNegativeFactor = 1e-3,
    ) -> None:
        super().__init__(views, trained)
        self.translation_penalty, self.rotation_penalty = translation_penalty, rotation_penalty
        chosen = list(range(views)) if trained is None else trained
        rows = torch.full((views + 1,), -1)  # the last entry is for view -1
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
        """Mean over trained views of translation_penalty |translation| + rotation_penalty |rotation vector|."""
        lengths = torch.linalg.vector_norm(self.motion.view(-1, 2, 3), dim=-1).mean(0)
        return self.translation_penalty * lengths[0] + self.rotation_penalty * lengths[1]


@CAMERAS.register("so3xr3")
class SO3xR3Refinement(RefinedPoses):
    """Rotation and translation are independent parameters."""

    exponential = staticmethod(exp_so3xr3)


@CAMERAS.register("se3")
class SE3Refinement(RefinedPoses):
    """The parameters are a twist: the translation follows the screw motion."""

    exponential = staticmethod(exp_se3)
