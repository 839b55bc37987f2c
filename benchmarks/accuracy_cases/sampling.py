"""Spacing curves, and drawing from the histograms of rays."""

import torch
from torch import Tensor

from benchmarks.accuracy_cases import EPS, Case, Function, fast_and_plain, only, rounded
from qnerf.rendering.pdf import sample_edges
from qnerf.rendering.spacing import SPACINGS

SPACED = 24 * EPS
"""Of each distance, relative to itself. The longest chain is geometric's: s ln(far / near) <= 21 has a rounding of half
of that, which exp passes on, and five more lie around it; disparity and piecewise take about six."""
DRAWN = EPS
"""Of edges in [0, 1] from the compiled loop, which works in float64: one rounding of the result, half an ulp of 1. The
plain form sums in the dtype it is given; where a weight is tiny its edges may lie anywhere in that interval."""
COUNT = 33


def spacing(name: str, near: float, far: float) -> Case:
    bounds = torch.tensor([[near]]).double().expand(128, 1), torch.tensor([[far]]).double().expand(128, 1)
    s = rounded(torch.linspace(0, 1, 97).expand(128, -1))

    def function(s: Tensor, near: Tensor, far: Tensor) -> Tensor:
        return SPACINGS.build(name, near, far).to_world(s)

    inputs = (s, *map(rounded, bounds))
    return Case("sampling", f"{name}, near {near:g}, far {far:g}", only(function), inputs, SPACED, gradient=None)


def drawing(name: str, weights: Tensor, edges: Tensor | None = None, padding: float = 0.01) -> Case:
    rays, bins = weights.shape
    generator = torch.Generator().manual_seed(5)
    s = torch.linspace(0, 1, bins + 1).expand(rays, -1) if edges is None else edges
    jitter = torch.rand(rays, 1, generator=generator)

    def function(s: Tensor, w: Tensor, jitter: Tensor) -> Tensor:
        return sample_edges(s, w, COUNT, padding=padding, jitter=jitter)

    variants: dict[str, Function] = fast_and_plain(function)
    return Case("sampling", name, variants, tuple(map(rounded, (s, weights, jitter))), DRAWN, gradient=None)


def cases() -> list[Case]:
    generator = torch.Generator().manual_seed(0)
    peaked = torch.rand(256, 96, generator=generator).pow(8)
    zero, spike = torch.zeros(256, 96), torch.zeros(256, 96)
    spike[:, 40] = 1
    random = torch.rand(256, 97, generator=generator).sort(-1).values
    twice = random.clone()
    twice[:, 1::2] = twice[:, :-1:2]
    return [
        spacing("uniform", 0.0, 1e6),
        spacing("piecewise", 0.05, 1000.0),
        spacing("piecewise", 0.0, 1e6),
        spacing("disparity", 0.05, 1e6),
        spacing("geometric", 1e-3, 1e6),
        drawing("96 random weights", peaked, random),
        drawing("all-zero weights", zero),
        drawing("all-zero weights, no padding", zero, padding=0.0),
        drawing("one spike", spike),
        drawing("one spike, no padding", spike, padding=0.0),
        drawing("weights of 1e-38", zero + 1e-38, random, padding=0.0),
        drawing("duplicated edges", peaked, twice),
    ]
