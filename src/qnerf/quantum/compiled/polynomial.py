"""Compiled evaluation of trigonometric polynomials and of their gradients, a vector of samples at a time.

Names: `width` samples in a block; (blocks, 2, n, width) `trig` with cos and sin of the inputs times their base
frequency.
"""

from typing import Any, NamedTuple

import numpy as np

from qnerf.kernels.jit import jit
from qnerf.kernels.simd import inner, keep_apart, load, splat, start_of_line, store


class Polynomials(NamedTuple):
    """The polynomial of each output. Compiled loops take it as it is."""

    highest: Any  # degree of any wire
    coefficients: Any  # (outputs, most coefficients), with zeros after an output's last one
    wires: Any  # (outputs, most wires) of each cone
    basis_sizes: Any  # (outputs, most wires) number of basis functions 1, cos, sin, ... of each of these wires
    wire_counts: Any  # (outputs,) wires in each cone


@inner
def _basis(x: Any, at: int, n: int, width: int, highest: int, trig: Any) -> None:
    """For each wire 1, cos(a), sin(a), cos(2 a), sin(2 a), ... at `at`, and after all wires their derivatives by a."""
    keep_apart()
    row = (2 * highest + 1) * width
    zero, one = splat(x.dtype.type(0)), splat(x.dtype.type(1))
    # cos and sin of (k + 1) a follow from k a and from a: a product of complex numbers instead of a cosine.
    for j in range(n):
        value, slope = at + j * row, at + (n + j) * row
        for i in range(width):
            x[value + width + i] = trig[0, j, i]
            x[value + 2 * width + i] = trig[1, j, i]
        store(x, value, one)
        store(x, slope, zero)
        c, s = load(x, value + width), load(x, value + 2 * width)
        u, v = c, s
        for k in range(highest):
            if k > 0:
                u, v = u * c - v * s, v * c + u * s
            factor = splat(x.dtype.type(k + 1))
            store(x, value + (2 * k + 1) * width, u)
            store(x, value + (2 * k + 2) * width, v)
            store(x, slope + (2 * k + 1) * width, zero - factor * v)
            store(x, slope + (2 * k + 2) * width, factor * u)


@inner
def _of(polynomials: Polynomials, output: int) -> Polynomials:
    """The polynomial of one output."""
    highest, coefficients, wires, basis_sizes, wire_counts = polynomials
    return Polynomials(highest, coefficients[output], wires[output], basis_sizes[output], wire_counts[output])


@inner
def _contract(x: Any, basis: int, row: int, width: int, polynomials: Polynomials, output: int, stages: int) -> int:
    """Contracts the coefficients of an output with the basis of the last wire, then of the one before, and so on.

    Every stage stays in the array, from `stages` on. Returns where the value lies.
    """
    keep_apart()
    _, coefficients, wires, basis_sizes, count = _of(polynomials, output)
    if count == 0:
        store(x, stages, splat(coefficients[0]))
        return stages
    # The first stage reads the coefficients, which are the same for all samples: total / size sums, each of `size`
    # products with the basis of the last wire.
    total = 1
    for w in range(count):
        total *= basis_sizes[w]
    size = basis_sizes[count - 1]
    b = basis + wires[count - 1] * row
    total //= size
    for m in range(total):
        value = splat(coefficients[m * size]) * load(x, b)
        for k in range(1, size):
            value = value + splat(coefficients[m * size + k]) * load(x, b + k * width)
        store(x, stages + m * width, value)
    # The others read the stage before, which has a vector of samples for each number. The backward pass needs them all.
    here = stages
    for w in range(count - 2, -1, -1):
        size = basis_sizes[w]
        b = basis + wires[w] * row
        after = here + total * width
        total //= size
        for m in range(total):
            value = load(x, here + m * size * width)  # basis function 0 is 1
            for k in range(1, size):
                value = value + load(x, here + (m * size + k) * width) * load(x, b + k * width)
            store(x, after + m * width, value)
        here = after
    return here


@inner
def _contract_backward(
    x: Any, basis: int, row: int, n: int, width: int, polynomials: Polynomials, output: int, end: int, g: int,
    adjoints: int, next_adjoints: int, sums: int, inputs: int,
) -> None:  # fmt: skip
    """The reverse of `_contract`: adds to `sums` of the coefficients and to `inputs`, one vector each."""
    keep_apart()
    _, coefficients, wires, basis_sizes, count = _of(polynomials, output)
    # Stage by stage, the last one first. `adjoints` are the gradients of the numbers of a stage. Times the
    # basis they are the gradients of the stage before; times the derivatives of the basis they give the gradient of
    # the wire's angle. Two arrays of adjoints take turns.
    store(x, adjoints, load(x, g))
    total, here = 1, end
    for w in range(count):
        size = basis_sizes[w]
        b = basis + wires[w] * row
        slope = basis + (n + wires[w]) * row
        change = load(x, inputs + wires[w] * width)
        first = w == count - 1  # this stage read the coefficients themselves
        before = here - total * size * width
        for m in range(total):
            adjoint = load(x, adjoints + m * width)
            if first:
                store(x, sums + m * size * width, load(x, sums + m * size * width) + adjoint)
            else:
                store(x, next_adjoints + m * size * width, adjoint)
            for k in range(1, size):
                i = (m * size + k) * width
                f = load(x, b + k * width)
                if first:
                    value = splat(coefficients[m * size + k])
                    store(x, sums + i, load(x, sums + i) + adjoint * f)
                else:
                    value = load(x, before + i)
                    store(x, next_adjoints + i, adjoint * f)
                change = change + (adjoint * value) * load(x, slope + k * width)
        store(x, inputs + wires[w] * width, change)
        adjoints, next_adjoints = next_adjoints, adjoints
        here = before
        total *= size
    if count == 0:
        store(x, sums, load(x, sums) + load(x, g))


@jit
def evaluate(first: int, last: int, parts: int, trig: Any, width: int, polynomials: Polynomials, out: Any) -> None:
    """Fills out (blocks, outputs, width) with the values."""
    highest, coefficients = polynomials.highest, polynomials.coefficients
    blocks, n = trig.shape[0], trig.shape[2]
    row = (2 * highest + 1) * width
    x = np.empty(2 * n * row + 2 * coefficients.shape[1] * width + 64, coefficients.dtype)
    basis = start_of_line(x)
    stages = basis + 2 * n * row
    # The basis of a block of samples is computed once and serves all outputs.
    for block in range(blocks * first // parts, blocks * last // parts):
        _basis(x, basis, n, width, highest, trig[block])
        for k in range(len(coefficients)):
            end = _contract(x, basis, row, width, polynomials, k, stages)
            for i in range(width):
                out[block, k, i] = x[end + i]


@jit
def gradients(
    first: int, last: int, parts: int, trig: Any, width: int, polynomials: Polynomials, gradient: Any, inputs_out: Any,
    sums_out: Any,
) -> None:  # fmt: skip
    """Gradients, given the gradients of the outputs: `gradient` (blocks, outputs, width).

    inputs_out (blocks, n, width): of the inputs, in units of the base frequency
    sums_out (parts, outputs, most coefficients): of the coefficients, summed over each part
    """
    highest, coefficients = polynomials.highest, polynomials.coefficients
    blocks, n, coefficient_count = trig.shape[0], trig.shape[2], coefficients.shape[1]
    row = (2 * highest + 1) * width
    outputs = len(coefficients)
    x = np.zeros(2 * n * row + ((4 + outputs) * coefficient_count + n + 2) * width + 64, coefficients.dtype)
    basis = start_of_line(x)
    stages = basis + 2 * n * row
    adjoints = stages + 2 * coefficient_count * width
    next_adjoints = adjoints + coefficient_count * width
    g = next_adjoints + coefficient_count * width
    inputs = g + width
    sums = inputs + n * width
    zero = splat(coefficients.dtype.type(0))
    # A part is a fixed range of blocks with sums of its own, so that no bit depends on the number of threads. The
    # values are computed again rather than kept since the forward pass.
    for part in range(first, last):
        for i in range(sums, sums + outputs * coefficient_count * width, width):
            store(x, i, zero)
        for block in range(blocks * part // parts, blocks * (part + 1) // parts):
            _basis(x, basis, n, width, highest, trig[block])
            for i in range(inputs, inputs + n * width, width):
                store(x, i, zero)
            for k in range(outputs):
                end = _contract(x, basis, row, width, polynomials, k, stages)
                for i in range(width):
                    x[g + i] = gradient[block, k, i]
                at = sums + k * coefficient_count * width
                _contract_backward(x, basis, row, n, width, polynomials, k, end, g, adjoints, next_adjoints, at, inputs)
            for j in range(n):
                for i in range(width):
                    inputs_out[block, j, i] = x[inputs + j * width + i]
        # The lanes are samples; they are added up once a part, in float64.
        for k in range(outputs):
            for m in range(coefficient_count):
                value = 0.0
                at = sums + (k * coefficient_count + m) * width
                for i in range(at, at + width):
                    value += x[i]
                sums_out[part, k, m] = value
