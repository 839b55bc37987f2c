"""From samples on rays to points in the unit cube, and which of them may hold density."""

import torch
from torch import Tensor

from qnerf.geometry.contraction import Box, Contraction
from qnerf.geometry.visibility import SpaceMask
from qnerf.kernels import points
from qnerf.kernels.dispatch import serves
from qnerf.types import Rays, Samples


def unit_points(
    rays: Rays, samples: Samples, contraction: Contraction, mask: SpaceMask | None
) -> tuple[Tensor, Tensor | None]:
    """The midpoints of K intervals on each of R rays.

    Returns:
        Points (R, K, 3) in the unit cube, and whether density may be there, (R, K) bool; None: everywhere.
    """
    ends = (rays.origins, rays.directions, samples.edges)
    differentiated = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in ends)
    but = "the rays need a gradient" if differentiated else None
    modules = [contraction] if mask is None else [contraction, mask]
    if not serves("sample places", *ends, modules=modules, but=but):
        unit = contraction(rays.along(samples.mids))
        return unit, None if mask is None else mask(unit)
    return points.places(*ends, *numbers_of(contraction), None if mask is None else mask.grid)


def numbers_of(contraction: Contraction) -> tuple[int, float]:
    """How a compiled loop knows a contraction that it serves: its kind, and h of a box."""
    return (points.BOX, contraction.half_extent) if isinstance(contraction, Box) else (points.CUBE, 1.0)
