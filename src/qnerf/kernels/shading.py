"""A field's raw values on a ray -> weights, and the shares and features of its colours: a compiled CPU loop each way.

The plain PyTorch reference is in `qnerf.rendering.shading.shade`: the density's activation, `volume_weights`,
`color_shares` and the shading, one after the other.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor

from qnerf.kernels import transmittance
from qnerf.kernels.exponentials import exp
from qnerf.kernels.hashgrid import U
from qnerf.kernels.jit import jit, run
from qnerf.kernels.loop import Loop

GRAIN = 256  # rays that are worth waking a thread for
KNOWN_ACTIVATIONS = ("trunc_exp", "softplus")  # of the raw density, by their numbers in `_density`
LEAST, LARGEST = np.exp(-15.0), np.exp(15.0)  # of trunc_exp's derivative
STEEP = 40.0  # from here on softplus(x) is x
Reference: TypeAlias = Callable[[Tensor], tuple[Tensor, ...]]  # raw values -> the same in plain PyTorch


class Options(NamedTuple):
    """What the loop is told besides the numbers."""

    activation: str
    initial: float  # factor on the density
    last_sample: bool  # whether a ray's last sample takes the transmittance that is left
    parts: int  # see `MergeShading`; 0: every sample gets a colour
    floor: float  # the smallest share of a part by which the derivative of its mean is divided


def _forward(
    keeps: bool, raw: Tensor, inside: Tensor | None, delta: Tensor, options: Options, reference: Reference
) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    rays, count, outputs = raw.shape
    parts, new = options.parts or count, raw.new_empty
    weights, after, samples, density = new(4, rays, count).unbind()
    shares, mean = new(rays, parts), new(rays, parts, outputs - 1)
    part = torch.empty(rays, count if options.parts else 0, dtype=torch.int32)  # that each sample belongs to
    kept = (after, weights, samples, part, shares, mean)
    run(_shade, rays, _numbers(raw, options), raw, _where(inside), delta, density, kept, grain=GRAIN)
    return (weights, shares, mean), kept


def _backward(needs: Sequence[bool], inputs: Sequence[Any], kept: Sequence[Tensor], *upstream: Tensor) -> tuple[Tensor]:
    raw, inside, delta, options, _ = inputs
    to_raw = torch.empty(raw.shape, dtype=raw.dtype)
    work = raw.new_empty(2, *delta.shape).unbind()
    arrays = (raw, _where(inside), delta, tuple(kept), upstream, work, to_raw)
    run(_shade_gradient, len(raw), _numbers(raw, options), options.floor, *arrays, grain=GRAIN)
    return (to_raw,)


SHADE = Loop("shading", lambda raw, inside, delta, options, reference: reference(raw), _forward, _backward)
"""Raw values (R, K, 1 + G) -> weights (R, K), shares (R, M) of the colours, and their geometry (R, M, G).

Its inputs are the raw values; where density may be, (R, K) bool, None for everywhere; lengths of the intervals (R, K);
`Options`; and a `Reference`.
"""


def _where(inside: Tensor | None) -> Tensor | np.ndarray:
    return np.empty(0, np.bool_) if inside is None else inside


def _numbers(raw: Tensor, options: Options) -> tuple[int, int, float, bool, int, int, float]:
    known = (KNOWN_ACTIVATIONS.index(options.activation), options.initial, options.last_sample, options.parts)
    return raw.shape[1], *known, raw.shape[2], torch.finfo(raw.dtype).tiny


@jit
def _density(x, activation):  # type: ignore[no-untyped-def]
    number = type(x)
    if activation == 0:
        return exp(x)
    if x > number(STEEP):
        return x
    return max(x, number(0)) + number(np.log1p(exp(-abs(x))))


@jit
def bounded(density):  # type: ignore[no-untyped-def]
    """The derivative of trunc_exp by its argument, from its value."""
    number = type(density)
    if density < number(LEAST):
        return number(LEAST)
    return number(LARGEST) if density > number(LARGEST) else density


@jit
def _slope(x, activation):  # type: ignore[no-untyped-def]
    """Derivative of `_density`."""
    number = type(x)
    if activation == 0:
        return bounded(exp(x))
    return number(1) / (number(1) + exp(-x)) if x < number(STEEP) else number(1)


@jit
def _shade(start, stop, options, raw, inside, delta, density, written):  # type: ignore[no-untyped-def]
    """Writes rays start..stop. `samples` are the shares of the samples, `part` is the part that each belongs to."""
    count, activation, initial, last_sample, parts, outputs, tiny = options
    after, weights, samples, part, shares, mean = written
    number = raw.dtype.type
    one, factor = number(1), number(initial)
    n, o = U(count), U(outputs)
    features = o - U(1)
    for ray in range(start, stop):
        first = U(ray) * n
        # The density of each interval, 0 outside the mask, and the weights.
        for i in range(first, first + n):
            density[i] = factor * _density(raw[i * o], activation)
        if inside.size:
            for i in range(first, first + n):
                density[i] = density[i] if inside[i] else number(0)
        transmittance.forward(ray, ray + 1, count, density, delta, after, weights)
        # The share of each sample in the ray's colour. The light that passes all of them may be the last one's.
        opacity = number(0)
        for i in range(first, first + n):
            samples[i] = weights[i]
            opacity += weights[i]
        if last_sample:
            samples[first + n - U(1)] += one - (one if opacity > one else opacity)
        if parts == 0:
            for i in range(first, first + n):
                shares[i] = samples[i]
                for f in range(features):
                    mean[i * features + f] = raw[i * o + U(1) + f]
            continue
        m = U(parts)
        out = U(ray) * m
        total = number(0)
        for i in range(first, first + n):
            total += samples[i]
        total = max(total, number(tiny))
        for j in range(out, out + m):
            shares[j] = number(0)
        for j in range(out * features, (out + m) * features):
            mean[j] = number(0)
        # A sample's part is that of the middle of its share, in a running sum that ends at 1. Sums are in float32 or
        # float64 as the reference's are, in the same order, so that both choose the same part.
        before = number(0)
        for i in range(first, first + n):
            before += samples[i]
            middle = (before - samples[i] / number(2)) / total
            own = min(max(np.int64(middle * number(parts)), 0), parts - 1)
            part[i] = own
            shares[out + U(own)] += samples[i]
        # The mean geometry of each part, weighted by the samples' shares of it.
        for i in range(first, first + n):
            own_part = out + U(part[i])
            weight = samples[i] / max(shares[own_part], number(tiny))
            for f in range(features):
                mean[own_part * features + f] += weight * raw[i * o + U(1) + f]


@jit
def _shade_gradient(start, stop, options, floor, raw, inside, delta, kept, upstream, work, to_raw):  # type: ignore[no-untyped-def]
    """Writes the gradients of rays start..stop."""
    count, activation, initial, last_sample, parts, outputs, tiny = options
    after, weights, samples, part, shares, mean = kept
    upstream_weights, to_shares, to_mean = upstream
    to_weights, to_density = work
    number = raw.dtype.type
    one, zero, factor = number(1), number(0), number(initial)
    n, m, o = U(count), U(parts), U(outputs)
    features = o - U(1)
    for ray in range(start, stop):
        first = U(ray) * n
        # Gradients of the samples' shares and of their geometry.
        if parts == 0:
            for i in range(first, first + n):
                to_weights[i] = to_shares[i]
                for f in range(features):
                    to_raw[i * o + U(1) + f] = to_mean[i * features + f]
        else:
            # The derivative of a part's mean m by a sample's share is (g - m) / S, with S of at least `floor`. A sample
            # of a part with next to no share gets a bounded gradient, see `MergeShading`.
            for i in range(first, first + n):
                own = U(ray) * m + U(part[i])
                weight = samples[i] / max(shares[own], number(tiny))
                inner = zero
                for f in range(features):
                    g = to_mean[own * features + f]
                    inner += g * (raw[i * o + U(1) + f] - mean[own * features + f])
                    to_raw[i * o + U(1) + f] = g * weight
                to_weights[i] = to_shares[own] + inner / max(shares[own], number(floor))
        # The last sample's share falls by what all weights take, unless they sum to more than 1 by rounding.
        opacity = zero
        for i in range(first, first + n):
            opacity += weights[i]
        taken = to_weights[first + n - U(1)] if last_sample and not opacity > one else zero
        for i in range(first, first + n):
            to_weights[i] += upstream_weights[i] - taken
        transmittance.backward(ray, ray + 1, count, delta, after, weights, to_weights, to_density)
        for i in range(first, first + n):
            to_raw[i * o] = to_density[i] * factor * _slope(raw[i * o], activation)
        if inside.size:
            for i in range(first, first + n):
                to_raw[i * o] = to_raw[i * o] if inside[i] else zero
