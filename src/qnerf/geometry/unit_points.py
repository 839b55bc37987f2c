"""From samples on rays to points in the unit cube, and which of them may hold density."""

import torch
from torch import Tensor

from qnerf.geometry.contraction import Box, Contraction, CubeContraction
from qnerf.geometry.visibility import SpaceMask
from qnerf.kernels import points, replaceable
from qnerf.types import Rays, Samples

LOOPS = {CubeContraction: points.CUBE, Box: points.BOX}
"""The contractions that the compiled loop knows; a class derived from one of them may be another function."""


def unit_points(
    rays: Rays, samples: Samples, contraction: Contraction, mask: SpaceMask | None
) -> tuple[Tensor, Tensor | None]:
    """The midpoints of K intervals on each of R rays.

    Returns:
        Points (R, K, 3) in the unit cube, and whether density may be there, (R, K) bool; None: everywhere.
    """
    kind = LOOPS.get(type(contraction))
    ends = (rays.origins, rays.directions, samples.edges)
    known = type(mask) in (type(None), SpaceMask) and replaceable(contraction, *([] if mask is None else [mask]))
    if kind is None or not known or not points.takes(*ends):
        unit = contraction(rays.along(samples.mids))
        return unit, None if mask is None else mask(unit)
    half_extent = contraction.half_extent if isinstance(contraction, Box) else 1.0
    unit, inside = points.unit_points(*ends, kind, half_extent, None if mask is None else mask.grid)
    shape = torch.Size((len(rays), samples.edges.shape[1] - 1))
    return unit.view(*shape, 3), None if inside is None else inside.view(shape)
