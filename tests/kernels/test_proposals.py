"""The loop through a proposal network against the operations that it stands for: kernels/proposals.py."""

from contextlib import nullcontext
from itertools import product

import pytest
import torch

from qnerf.geometry.contraction import Box, CubeContraction
from qnerf.geometry.visibility import SpaceMask
from qnerf.kernels import plain
from qnerf.kernels.dispatch import report
from qnerf.kernels.proposals import KNOWN_SPACINGS
from qnerf.rendering.proposal_sampler import ProposalSampler
from qnerf.types import Rays


def sampler(**options):
    torch.manual_seed(0)
    made = ProposalSampler(CubeContraction(), samples=[10, 7], final=5, max_resolutions=[16, 24], **options)
    for network in made.networks:
        torch.nn.init.uniform_(network.encoder.table, -2, 2)
    return made


def rays(count, dtype):
    directions = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
    ends = torch.rand(2, count, 1) + torch.tensor([0.05, 3.0])[:, None, None]
    views = torch.zeros(count, dtype=torch.int64)
    return Rays(torch.rand(count, 3).to(dtype), directions.to(dtype), views, *ends.to(dtype))


def values(found):
    proposals = [value for samples, weights in found.proposals for value in (samples.edges, samples.spacing, weights)]
    return [found.samples.edges, found.samples.spacing, *proposals]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_proposals_of_the_loop_are_those_of_the_operations(dtype):
    """Of all spacings, contractions and masks, from the first step to the end of annealing, with and without jitter."""
    mask = SpaceMask(torch.rand(8, 8, 8, generator=torch.Generator().manual_seed(0)) < 0.6)
    for spacing, step, where, jitter in product(KNOWN_SPACINGS, (0, 40, 2000), (None, mask), (True, False)):
        one = sampler(spacing=spacing).to(dtype)
        one.contraction = CubeContraction() if jitter else Box(half_extent=2.0)
        one.mask = where
        found = []
        with torch.no_grad(), report() as aside:
            given = rays(70, dtype)
            for form in (nullcontext(), plain()):
                draws = torch.Generator().manual_seed(1) if jitter else None
                with form:
                    found.append(values(one(given, torch.zeros_like, generator=draws, step=step)))
        assert set(aside.values()) <= {"inside plain()"}
        for ours, theirs in zip(*found, strict=True):
            near = 1e-4 if dtype == torch.float32 else 1e-10
            torch.testing.assert_close(ours, theirs, rtol=near, atol=near)


def test_proposals_step_aside_for_another_component():
    class Other(CubeContraction):
        pass

    one = sampler()
    one.contraction = Other()
    with torch.no_grad(), report() as aside:
        one(rays(4, torch.float32), torch.zeros_like)
    assert aside["proposals"] == "Other extends CubeContraction"
