"""Encodings of points, and the activations of densities.

These are for given points. Points along a ray are themselves rounded to about 2e-7 of the unit cube, 4e-4 of a cell
where 2,048 lie on a side: gradients into poses through such a hash grid are right to 2e-3 only, and a point within that
of a border may take the slope of the neighbouring cell.
"""

from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor

from benchmarks.accuracy_cases import EPS, Case, fast_and_plain, only, rounded
from qnerf.encoders import ENCODERS, level_resolutions
from qnerf.heads.activations import softplus, trunc_exp
from qnerf.kernels.grid_mlp import Grid, grid_mlp, grid_mlp_reference
from qnerf.kernels.hashgrid import hash_encode, hash_encode_reference
from qnerf.kernels.mlp import layers_of, mlp, mlp_reference

PHASES = 5e-7
"""Of sines and cosines whose phases are reduced in float64: half an ulp of pi for the phase, an ulp of 1 after it."""
FEATURES = 16 * EPS
"""Relative to the table's largest entry, at any resolution. The place in the cell is rounded once, the weights of the 8
corners four times more, their sum of 8 eight times."""
LAYERS = 64 * EPS
"""Relative to the largest value: the features' error, and that of sums of up to 64 products in any order, a layer."""
ACTIVATED = 4 * EPS
"""Relative to each value."""


def hashed(name: str, points: Tensor, levels: tuple[int, int, int], log2_size: int, features: int) -> Case:
    """levels: number, coarsest and finest resolution."""
    cells = torch.tensor(level_resolutions(*levels))
    generator = torch.Generator().manual_seed(1)
    table = 2 * torch.rand(levels[0], 2**log2_size, features, generator=generator) - 1
    variants = fast_and_plain(hash_encode, hash_encode_reference)
    return Case("hash grid", name, variants, (rounded(points), rounded(table), cells), FEATURES)


def with_layers(
    name: str, points: Tensor, levels: tuple[int, int, int], features: int, units: int, outputs: int
) -> Case:
    """A hash grid and two linear layers on it, with the weights that they start with."""
    cells = torch.tensor(level_resolutions(*levels))
    generator = torch.Generator().manual_seed(2)
    inputs = levels[0] * features
    table = 2 * torch.rand(levels[0], 2**15, features, generator=generator) - 1
    w1, w2 = (
        torch.randn(rows, columns, generator=generator) * (2 / columns) ** 0.5
        for rows, columns in ((units, inputs), (outputs, units))
    )
    biases = torch.zeros(units), torch.zeros(outputs)

    def on_grid(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
        def values(table: Tensor, w1: Tensor, b1: Tensor, w2: Tensor, b2: Tensor) -> Tensor:
            return function(points.to(table.dtype), None, Grid(table, cells, True), layers_of((w1, b1, w2, b2)))

        return values

    variants = fast_and_plain(on_grid(grid_mlp), on_grid(grid_mlp_reference))
    parameters = tuple(map(rounded, (table, w1, biases[0], w2, biases[1])))
    return Case("hash grid with layers", name, variants, parameters, LAYERS)


def layered(name: str, *widths: int, rows: int, scale: float = 1.0) -> Case:
    """Linear layers of these widths on random rows, whose first feature is so many times as large."""
    generator = torch.Generator().manual_seed(3)
    given = torch.randn(rows, widths[0], generator=generator)
    given[:, 0] *= scale
    parameters = []
    for inputs, outputs in pairwise(widths):
        parameters.append(torch.randn(outputs, inputs, generator=generator) * (2 / inputs) ** 0.5)
        parameters.append(torch.randn(outputs, generator=generator) / 4)

    def on(function: Callable[..., Tensor]) -> Callable[..., Tensor]:
        return lambda rows, *parameters: function(rows, layers_of(parameters))

    variants = fast_and_plain(on(mlp), on(mlp_reference))
    return Case("MLP", name, variants, tuple(map(rounded, (given, *parameters))), LAYERS)


def phased(name: str, points: Tensor, **options: float) -> Case:
    encoder = ENCODERS.build(name, 3, **options)
    return Case("frequencies", name, only(encoder), (rounded(points),), PHASES)


def cases() -> list[Case]:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(8192, 3, generator=generator, dtype=torch.float64)
    borders = (points * 512).round() / 512
    corners = torch.tensor([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
    x = rounded(torch.cat([torch.linspace(-60, 60, 8192), torch.tensor([-80.0, 80.0])]))
    return [
        hashed("C5", points, (12, 16, 1024), 15, 1),
        hashed("cells to 2,048, 2 features", points, (16, 16, 2048), 13, 2),
        hashed("cells to 2^17", points, (4, 16, 2**17), 15, 1),
        hashed("cell borders", borders, (4, 64, 512), 15, 2),
        hashed("0 and 1 exactly", corners, (12, 16, 1024), 15, 1),
        hashed("outside [0, 1]", 3 * points - 1, (12, 16, 1024), 15, 1),
        with_layers("a proposal network", rounded(points), (5, 16, 128), 2, 16, 1),
        with_layers("density, 2 x 64", rounded(points), (12, 16, 1024), 1, 64, 6),
        layered("colour, 3 x 64", 22, 64, 64, 3, rows=1500),
        layered("one unit, 5 rows", 3, 1, 1, rows=5),
        layered("a feature 1,000 times the others", 22, 64, 64, 3, rows=1500, scale=1000.0),
        phased("pe", points),
        phased("rff", points, scale=4.0),
        Case("activations", "trunc_exp", only(trunc_exp), (x,), ACTIVATED),
        Case("activations", "softplus", only(softplus), (x,), ACTIVATED),
    ]
