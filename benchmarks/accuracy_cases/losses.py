"""The regularisers of the histograms of rays.

The interlevel loss compares differences of running sums with weights of 1e-7 and less, so both forms sum in float64. In
float32 three quarters of the gradients that it gives to a trained scene are rounding errors. With them, `train=paper
field=classical` ends at 32.59 dB on `poster`, and at 32.75 without (seed 1).
"""

import torch
from torch import Tensor

from benchmarks.accuracy_cases import EPS, Case, Function, fast_and_plain, rounded
from qnerf.training.losses import distortion, interlevel
from qnerf.types import Samples

LOSSES = 4 * EPS
"""Relative, of the compiled loops: they sum in float64; only the result is rounded, and the mean over rays."""


def _distorted(s: Tensor, weights: Tensor) -> Tensor:
    return distortion(Samples(s, s), weights)


def _bounded(proposed: Tensor, s: Tensor, weights: Tensor, outer: Tensor) -> Tensor:
    return interlevel(Samples(s, s), weights, [(Samples(outer, outer), proposed)])


def case(name: str, function: Function, *inputs: Tensor, wanted: int) -> Case:
    return Case("losses", name, fast_and_plain(function), tuple(map(rounded, inputs)), LOSSES, wanted=(wanted,))


def cases() -> list[Case]:
    generator = torch.Generator().manual_seed(0)

    def random(count: int) -> Tensor:
        return torch.rand(256, count, generator=generator, dtype=torch.float64)

    s, outer = random(33).sort(-1).values, random(97).sort(-1).values
    weights, proposed = random(32) / 32, random(96) / 96
    coincident = s.clone()
    coincident[:, 1::2] = coincident[:, :-1:2]
    spike = torch.zeros(256, 32).double()
    spike[:, 15:17] = 0.5
    narrow = torch.cat([torch.zeros(256, 15), torch.linspace(0.7, 0.7001, 3).expand(256, 3), torch.ones(256, 15)], 1)
    zero = torch.zeros(256, 32)
    behind_a_wall = 1e-6 * random(96)
    behind_a_wall[:, 0] = 0.9
    return [
        case("distortion", _distorted, s, weights, wanted=1),
        case("distortion, coincident edges", _distorted, coincident, weights, wanted=1),
        case("distortion, one narrow spike", _distorted, narrow, spike, wanted=1),
        case("distortion, zero weights", _distorted, s, zero, wanted=1),
        case("interlevel", _bounded, proposed, s, weights, outer, wanted=0),
        case("interlevel, zero weights", _bounded, torch.zeros(256, 96), s, zero, outer, wanted=0),
        case("interlevel, weights of 1e-38", _bounded, proposed * 0, s, zero + 1e-38, outer, wanted=0),
        case("interlevel, small weights behind 0.9", _bounded, behind_a_wall, s, 1e-6 * weights, outer, wanted=0),
        case("interlevel, proposals of 0", _bounded, proposed * 0, s, weights, outer, wanted=0),
    ]
