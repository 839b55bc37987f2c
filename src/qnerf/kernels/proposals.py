"""The way of a ray through a proposal network, from its first edges to the next ones, in one compiled CPU loop.

It is what `qnerf.rendering.proposal_sampler` does, which is the plain PyTorch reference: each other loop of the way,
called for a few rays at a time. It makes no gradients: in steps in which the networks learn, the loops are called one
by one.
"""

from math import gcd
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from qnerf.kernels.exponentials import exp, log
from qnerf.kernels.grid_mlp import Grid, network_values
from qnerf.kernels.hashgrid import BLOCK, U
from qnerf.kernels.histogram import draw_edges
from qnerf.kernels.jit import jit, run
from qnerf.kernels.mlp import Layer, packed
from qnerf.kernels.points import place
from qnerf.kernels.transmittance import forward

RAYS = 32  # at least so many rays at a time
KNOWN_SPACINGS = ("uniform", "disparity", "geometric", "piecewise")  # by their numbers in `to_world`


class Space(NamedTuple):
    """Rays, and how the unit cube is laid into the world around them."""

    origins: Tensor  # (R, 3) world units
    directions: Tensor  # (R, 3)
    near: Tensor  # (R, 1) world units
    far: Tensor  # (R, 1)
    spacing: str
    contraction: int  # see `points`
    half_extent: float
    mask: Tensor | None  # (n, n, n) bool: where density may be; None: everywhere


class Draws(NamedTuple):
    """How the next edges are drawn from a proposal's weights."""

    edges: int  # to draw
    jitter: Tensor | None  # (R, 1) of the edges drawn; None: 1/2
    padding: float  # added to each weight
    min_total: float  # see `qnerf.rendering.pdf`


def propose(
    space: Space, s: Tensor, network: tuple[Grid, list[Layer]], draws: Draws, exponent: float
) -> tuple[Tensor, Tensor, Tensor]:
    """One network's proposals for R rays.

    Args:
        s: (R, K + 1) edges in the normalised coordinate.
        network: as `grid_mlp` takes it.
        exponent: power of the weights from which edges are drawn.

    Returns:
        Edges (R, K + 1) in world units, weights (R, K), and the edges drawn in the normalised coordinate.
    """
    (table, resolutions, dense), layers = network
    s = s.contiguous()  # even edges are the same for all rays
    rays, count = s.shape[0], s.shape[1] - 1
    t, weights, drawn = s.new_empty(s.shape), s.new_empty(rays, count), s.new_empty(rays, draws.edges)
    density, delta, after, annealed = s.new_empty(4, rays, count).unbind()
    unit = s.new_empty(rays * count, 3)
    inside = torch.empty(0 if space.mask is None else rays * count, dtype=torch.bool)
    cells, side = (inside, 0) if space.mask is None else (space.mask, space.mask.shape[0])
    group, spacing = _group(count), KNOWN_SPACINGS.index(space.spacing)
    jitter = np.full(rays, 0.5, s.numpy().dtype) if draws.jitter is None else draws.jitter
    packed_layers = packed([tensor for layer in layers for tensor in layer])
    run(
        _propose,
        -(-rays // group),
        group,
        (space.origins, space.directions, space.near, space.far, spacing),
        (space.contraction, space.half_extent, cells, side),
        (s, s.numpy()),
        (table, resolutions, dense, table.shape[2]),
        packed_layers,
        (jitter, draws.padding, draws.min_total, exponent),
        (t, weights.numpy(), drawn.numpy()),
        (inside, unit, density, delta, after, annealed),
        grain=1,
    )
    return t, weights, drawn


def in_world(space: Space, s: Tensor) -> Tensor:
    """Edges (R, K + 1) of the normalised coordinate in world units."""
    t = torch.empty_like(s)
    run(to_world, len(s), KNOWN_SPACINGS.index(space.spacing), space.near, space.far, s, t, grain=8 * RAYS)
    return t


def _group(count: int) -> int:
    """Rays whose samples, `count` a ray, are whole blocks of points; at least RAYS.

    >>> [_group(count) for count in (64, 48, 6, 5)]
    [32, 32, 64, 128]
    """
    whole = BLOCK // gcd(BLOCK, count)
    return whole * -(-RAYS // whole)


@jit
def to_world(start, stop, spacing, near, far, s, t):  # type: ignore[no-untyped-def]
    """Writes the edges of rays start..stop in world units: `qnerf.rendering.spacing`."""
    number = s.dtype.type
    one, half, two = number(1), number(0.5), number(2)
    edges = U(s.size // near.size)
    for ray in range(U(start), U(stop)):
        a, b, first = near[ray], far[ray], ray * edges
        if spacing == 0:
            for i in range(first, first + edges):
                t[i] = a + (b - a) * s[i]
        elif spacing == 1:
            for i in range(first, first + edges):
                t[i] = one / (one / b + (one / a - one / b) * (one - s[i]))
        elif spacing == 2:
            largest = number(0)
            for i in range(first, first + edges):
                largest = max(largest, min(a * exp(s[i] * np.log(b / a)), b))  # exp need not grow to the last bit
                t[i] = largest
        # Near the end the curve comes from 1 - g, which keeps its digits where g rounds to 1.
        else:
            g_near, rest_near = (a / two, one - a / two) if a < one else (one - half / a, half / a)
            g_far, rest_far = (b / two, one - b / two) if b < one else (one - half / b, half / b)
            width, rest = g_far - g_near, rest_near - rest_far
            for i in range(first, first + edges):
                curve = g_near + width * s[i]
                beyond = half / (rest_far + rest * (one - s[i]))
                t[i] = curve * two if curve < half else max(beyond, one)


@jit
def _propose(start, stop, group, rays, space, s, grid, layers, draws, written, work):  # type: ignore[no-untyped-def]
    """Proposes for the groups start..stop of rays."""
    origins, directions, near, far, spacing = rays
    flat_s, s_rows = s
    jitter, padding, min_total, exponent = draws
    edges, weights, drawn = written
    inside, unit, density, delta, after, annealed = work
    number = flat_s.dtype.type
    all_rays, count = weights.shape
    block = np.int64(BLOCK)
    shares, power = weights.reshape(-1), number(exponent)
    n = U(count)
    # Nothing is kept of the network's values for a backward pass.
    number_of = np.empty((1, 0), np.int32)
    nothing = np.empty((1, 0), flat_s.dtype), number_of, number_of[0]
    powers = annealed.reshape(all_rays, count)
    for each in range(start, stop):
        first = each * group
        last = min(first + group, all_rays)
        # Edges in world units, and the midpoints in the unit cube.
        to_world(first, last, spacing, near, far, flat_s, edges)
        place(first, last, (origins, directions, edges, count), space, unit, inside)
        # The network's raw values: a group of rays is whole blocks of points.
        blocks = first * count // block, (last * count + block - 1) // block
        network_values(blocks[0], blocks[1], unit, inside, grid, layers, nothing, density)
        for ray in range(U(first), U(last)):
            for k in range(n):
                i, e = ray * n + k, ray * (n + U(1)) + k
                density[i] = exp(density[i])
                delta[i] = edges[e + U(1)] - edges[e]
        forward(first, last, count, density, delta, after, shares)
        # Early in training the next edges are drawn from a small power of the weights. A weight of 0 stays 0.
        if exponent == 1.0:
            draw_edges(first, last, s_rows, weights, jitter, padding, min_total, drawn)
        else:
            for i in range(U(first) * n, U(last) * n):
                annealed[i] = exp(power * log(shares[i])) if shares[i] > number(0) else shares[i]
            if exponent == 0.0:
                for i in range(U(first) * n, U(last) * n):
                    annealed[i] = number(1)
            draw_edges(first, last, s_rows, powers, jitter, padding, min_total, drawn)
