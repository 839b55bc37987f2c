"""Points of rays in the unit cube: the compiled loop against rays, contraction and mask."""

import torch

from qnerf.geometry.contraction import CONTRACTIONS, Box
from qnerf.geometry.unit_points import unit_points
from qnerf.geometry.visibility import SpaceMask
from qnerf.kernels import plain
from qnerf.types import Rays, Samples


def along(dtype, longest):
    """Rays with intervals from 1e-3 to `longest` world units; one ray is not a number."""
    generator = torch.Generator().manual_seed(0)
    rays, samples = 70, 37
    origins = torch.randn(rays, 3, generator=generator, dtype=torch.float64)
    directions = torch.nn.functional.normalize(torch.randn(rays, 3, generator=generator, dtype=torch.float64), dim=-1)
    directions[5] = torch.nan
    exponents = torch.rand(rays, samples + 1, generator=generator, dtype=torch.float64).sort(-1).values
    edges = (1e-3 * (longest / 1e-3) ** exponents).to(dtype)
    bounds = torch.full((rays, 1), 1e-3, dtype=dtype), torch.full((rays, 1), longest, dtype=dtype)
    views = torch.zeros(rays, dtype=torch.int64)
    return Rays(origins.to(dtype), directions.to(dtype), views, *bounds), Samples(edges, edges)


def test_the_loop_gives_the_points_of_the_modules_to_the_last_bit():
    for dtype in (torch.float32, torch.float64):
        for name in CONTRACTIONS.names():
            for longest in (3.0, 1e6, 1e38):
                rays, samples = along(dtype, longest)
                contraction = CONTRACTIONS.build(name)
                mask = SpaceMask(torch.rand(6, 6, 6, generator=torch.Generator().manual_seed(1)) < 0.5)
                fast = unit_points(rays, samples, contraction, mask)
                with plain():
                    slow = unit_points(rays, samples, contraction, mask)
                torch.testing.assert_close(fast, slow, rtol=0, atol=0, equal_nan=True)
                assert fast[0][5].isnan().all()
                assert unit_points(rays, samples, contraction, None)[1] is None


def test_a_contraction_and_a_mask_of_ones_own_are_called():
    class Half(Box):
        def forward(self, points):
            return super().forward(points) / 2

    class Outside(SpaceMask):
        def forward(self, unit):
            return ~super().forward(unit)

    rays, samples = along(torch.float32, 3.0)
    halved, whole = (unit_points(rays, samples, contraction, None)[0] for contraction in (Half(), Box()))
    torch.testing.assert_close(2 * halved, whole, equal_nan=True)
    cells = torch.rand(6, 6, 6, generator=torch.Generator().manual_seed(1)) < 0.5
    own, usual = (unit_points(rays, samples, Box(), kind(cells))[1] for kind in (Outside, SpaceMask))
    assert torch.equal(own, ~usual)
