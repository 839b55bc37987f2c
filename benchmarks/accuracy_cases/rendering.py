"""Volume rendering, and whole pixels of fields with each encoder.

Pixels are those of the same parameters and the same distances along the same rays: points, contraction, encoding,
heads and compositing are all in the one dtype or the other. No bound holds for the pixel of a sample that lies within a
rounding of a border of the visibility mask: it is in or out.

Behind an opaque sample the transmittance is e^-tau, and below 10^-38 (tau = 88) it has no digits left: it is 0.
"""

import copy

import torch
from torch import Tensor, nn

from benchmarks.accuracy_cases import EPS, Case, Function, fast_and_plain, rounded
from qnerf.encoders import DIRECTIONS, ENCODERS
from qnerf.geometry.contraction import CONTRACTIONS
from qnerf.heads import HEADS
from qnerf.heads.activations import sigmoid, trunc_exp
from qnerf.model.field import Field
from qnerf.rendering.render import render, volume_weights, volume_weights_reference
from qnerf.types import Samples

WEIGHTS = 16 * EPS
"""Relative to the ray's largest weight w. A weight is opacity times T = e^-tau: 4 roundings for the two exponentials
and their product, tau roundings for the product and the sum in the exponent. T tau <= 1/e wherever the intervals are
alike, and at most ln(K) w where one interval outweighs K thin ones: 9.3 for K = 10^4."""
WEIGHT_GRADIENTS = 100 * EPS
"""Relative to delta_i T_(i+1) max |g|, the size of the gradient's terms. Their T = e^-tau is off by tau + 4 roundings,
and tau is below 88 where T is a normal float32 at all."""
PIXELS = 1e-5
"""Of colours in [0, 1], for the same weights and distances along the rays: what is asked for."""


def weights(name: str, density: Tensor, delta: Tensor) -> Case:
    inputs = (rounded(density), rounded(delta))
    variants = fast_and_plain(volume_weights, volume_weights_reference)
    return Case("rendering", name, variants, inputs, WEIGHTS, wanted=(0,))


def _rays(rays: int = 256, samples: int = 32) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    density = torch.rand(rays, samples, generator=generator, dtype=torch.float64).mul(12).sub(6).exp()
    return density, torch.rand(rays, samples, generator=generator, dtype=torch.float64) * 0.2


class SmallField(nn.Module):
    """A field of a run's kind and size, with features as large as trained ones: edges (R, K + 1) -> pixels (R, 3)."""

    def __init__(self, encoder: str, rays: int, **options: int) -> None:
        super().__init__()
        torch.manual_seed(0)
        encoding = ENCODERS.build(encoder, 3, **options)
        if encoder == "hash":
            nn.init.uniform_(encoding.table, -1, 1)  # trained tables of 400 steps reach 0.7
        sh = DIRECTIONS.build("sh")
        density = HEADS.build("mlp", encoding.out_dim, 6, layers=2, width=64)
        color = HEADS.build("mlp", sh.out_dim + 5, 3, layers=3, width=64)
        contraction = CONTRACTIONS.build("linf")
        self.field = Field(
            contraction, encoding, sh, density, color, trunc_exp, sigmoid, 1.0, views=1, trained=[0], appearance=0
        )
        self.origins = nn.Parameter(torch.rand(rays, 3) - 0.5)
        self.directions = nn.Parameter(nn.functional.normalize(torch.randn(rays, 3), dim=-1))

    def forward(self, edges: Tensor) -> Tensor:
        samples = Samples(edges, edges)
        points = self.origins[:, None] + self.directions[:, None] * samples.mids[..., None]
        cameras = torch.zeros(len(edges), dtype=torch.int64)
        density, color = self.field(points, self.directions, cameras)
        weights = volume_weights(density * 3, samples.deltas)
        return render(weights, color, samples, background="last_sample")[0].color


def pixels(name: str, encoder: str, rays: int = 256, samples: int = 32, **options: int) -> Case:
    single = SmallField(encoder, rays, **options).requires_grad_(False)
    double = copy.deepcopy(single).double()

    def function(edges: Tensor) -> Tensor:
        return (single if edges.dtype == torch.float32 else double)(edges)

    generator = torch.Generator().manual_seed(1)
    even = torch.rand(rays, samples + 1, generator=generator, dtype=torch.float64).sort(-1).values
    edges = rounded(0.05 + 4 * even**2)
    variants: dict[str, Function] = fast_and_plain(function)
    return Case("pixels", name, variants, (edges,), PIXELS, gradient=None)


def cases() -> list[Case]:
    density, delta = _rays()
    opaque, empty, long = density.clone(), torch.zeros_like(density), torch.full((4, 10_000), 0.5).double()
    opaque[:, 0] = 150.0  # with a length of 0.2: a transmittance of 1e-13 behind it
    lengths = delta.clone()
    lengths[:, 0] = 0.2
    mixed = density.clone()
    mixed[:, ::3], mixed[:, 1::7], mixed[:, 20] = 0, 1e-30, 1e10
    still = delta.clone()
    still[:, ::2] = 0
    return [
        weights("256 rays of 32 samples", density, delta),
        weights("sigma of 0, 1e-30 and 1e10", mixed, delta),
        weights("delta of 0", density, still),
        weights("opaque first sample", opaque, lengths),
        weights("empty ray", empty, delta),
        weights("1e-30 everywhere", empty + 1e-30, delta),
        weights("10^4 samples", long, torch.full_like(long, 1e-3)),
        pixels("no encoding", "none"),
        pixels("pe, 10 bands to 2^8", "pe"),
        pixels("rff", "rff", scale=4),
        pixels("hash C5", "hash", levels=12, max_resolution=1024, log2_table_size=15),
        pixels("hash, cells to 2,048", "hash", levels=16, max_resolution=2048, log2_table_size=13, features=2),
    ]
