"""Spacing curves: distance t in [near, far] along a ray <-> the normalised coordinate s in [0, 1].

A curve g gives s = (g(t) - g(near)) / (g(far) - g(near)) (Eq. 11, arXiv:2111.12077). Each object is built for the
bounds of R rays and maps (R, K) to (R, K). The arithmetic is monotone in floating point: ordered s give ordered t, also
for far = 1e6 in float32.
"""

from abc import ABC, abstractmethod

import torch
from torch import Tensor

from qnerf.config.registry import Registry

SPACINGS: "Registry[Spacing]" = Registry("spacing")


class Spacing(ABC):
    """Built from near, far: (R, 1) distances in world units, 0 <= near < far.

    >>> disparity = SPACINGS.build("disparity", torch.tensor([[1.0]]), torch.tensor([[2.0]]))
    >>> [round(t, 4) for t in disparity.to_world(torch.tensor([[0.0, 0.5, 1.0]]))[0].tolist()]
    [1.0, 1.3333, 2.0]
    """

    @abstractmethod
    def __init__(self, near: Tensor, far: Tensor) -> None: ...

    @abstractmethod
    def to_world(self, s: Tensor) -> Tensor:
        """Normalised coordinate (R, K) in [0, 1] -> distance (R, K) in world units."""


def _require_positive(name: str, near: Tensor) -> None:
    if not bool((near > 0).all()):
        raise ValueError(
            f"spacing={name} needs near above 0, got {float(near.min()):g}; known for near = 0: piecewise, uniform"
        )


@SPACINGS.register("uniform")
class Uniform(Spacing):
    """g(t) = t."""

    def __init__(self, near: Tensor, far: Tensor) -> None:
        self.near, self.width = near, far - near

    def to_world(self, s: Tensor) -> Tensor:
        return torch.addcmul(self.near, self.width, s)


@SPACINGS.register("disparity")
class Disparity(Spacing):
    """g(t) = -1/t: equal steps in inverse distance. ValueError unless near > 0."""

    def __init__(self, near: Tensor, far: Tensor) -> None:
        _require_positive("disparity", near)
        self.last = far.reciprocal()
        self.width = near.reciprocal() - self.last

    def to_world(self, s: Tensor) -> Tensor:
        return torch.addcmul(self.last, self.width, 1 - s).reciprocal()


@SPACINGS.register("geometric")
class Geometric(Spacing):
    """g(t) = log t: the distance grows by a constant factor. ValueError unless near > 0."""

    def __init__(self, near: Tensor, far: Tensor) -> None:
        _require_positive("geometric", near)
        self.near, self.far, self.width = near, far, (far / near).log()

    def to_world(self, s: Tensor) -> Tensor:
        t = torch.minimum(self.near * (s * self.width).exp(), self.far)
        return t.cummax(-1).values  # exp need not be monotone to the last bit


@SPACINGS.register("piecewise")
class Piecewise(Spacing):
    """g(t) = t/2 for t < 1, else 1 - 1/(2t): equal steps up to distance 1, then equal steps in inverse distance."""

    def __init__(self, near: Tensor, far: Tensor) -> None:
        self.first = self._curve(near)
        self.width = self._curve(far) - self.first
        # The far half uses 1 - g, which keeps its digits where g rounds to 1.
        self.last = self._rest(far)
        self.rest = self._rest(near) - self.last

    @staticmethod
    def _curve(t: Tensor) -> Tensor:
        return torch.where(t < 1, t / 2, 1 - 0.5 / t)

    @staticmethod
    def _rest(t: Tensor) -> Tensor:
        return torch.where(t < 1, 1 - t / 2, 0.5 / t)

    def to_world(self, s: Tensor) -> Tensor:
        curve = torch.addcmul(self.first, self.width, s)
        beyond = torch.addcmul(self.last, self.rest, 1 - s).reciprocal().mul(0.5).clamp(min=1)
        return torch.where(curve < 0.5, curve * 2, beyond)
