"""Compiled passes of the backward sweep; layout as in `passes`.

The dual state is lambda = sum_k g_k O_k |psi> at the end, and is pulled back gate by gate. The gradient of an angle
whose generator is G / 2 is Im <lambda| G |psi>. Passes that only read are arranged so that each chunk of states is
met once.
"""

from typing import Any

from qnerf.quantum.compiled.forward_passes import fold
from qnerf.quantum.compiled.simd import inner, keep_apart, load, splat, store
from qnerf.quantum.compiled.wire_blocks import gradient_block, mix_block

LOW = 5  # wires whose amplitudes (2^LOW vectors of two states) stay in the first-level cache


@inner
def _gradient(
    x: Any, state: int, dual: int, outer: int, distance: int, size: int, width: int, zeros: Any, out: int
) -> None:
    """Adds to the vectors at `out` of a few neighbouring wires."""
    keep_apart()
    real, imaginary = zeros, zeros
    span = distance << (len(zeros) >> 1)
    for h in range(outer):
        for i in range(h * span, h * span + distance, width):
            real = gradient_block(x, state + i, dual + i, distance, real)
            imaginary = gradient_block(x, state + i + size, dual + i + size, distance, imaginary)
    for j in range(len(zeros) >> 1):
        value = (real[2 * j] - real[2 * j + 1]) + (imaginary[2 * j] - imaginary[2 * j + 1])
        store(x, out + j * width, load(x, out + j * width) + value)


@inner
def _gradients(x: Any, state: int, dual: int, wires: int, below: int, size: int, width: int, out: int) -> None:
    """`wires` neighbouring wires with `below` less significant ones."""
    keep_apart()
    zero = splat(x.dtype.type(0))
    j = 0
    while wires - j >= 3:
        six = (zero, zero, zero, zero, zero, zero)
        _gradient(x, state, dual, 1 << j, width << (below + wires - j - 3), size, width, six, out + j * width)
        j += 3
    if wires - j == 2:
        _gradient(x, state, dual, 1 << j, width << below, size, width, (zero, zero, zero, zero), out + j * width)
    elif wires - j == 1:
        _gradient(x, state, dual, 1 << j, width << below, size, width, (zero, zero), out + j * width)


@inner
def turn_gradient(x: Any, state: int, dual: int, n: int, width: int, out: int) -> None:
    """Sum over pairs of Re(conj(dual_1) state_0 - conj(dual_0) state_1), for each wire a vector at `out`."""
    keep_apart()
    size = width << n
    zero = splat(x.dtype.type(0))
    for i in range(out, out + n * width, width):
        store(x, i, zero)
    low = min(n, LOW)
    chunk = width << low
    for c in range(1 << (n - low)):
        _gradients(x, state + c * chunk, dual + c * chunk, low, 0, size, width, out + (n - low) * width)
    _gradients(x, state, dual, n - low, low, size, width, out)


@inner
def phase_pull(
    x: Any, state: int, dual: int, n: int, width: int, table: Any, phases: int, mask: int, q: int, out: int
) -> None:
    """Gradients sum_b z_j Im(conj(dual) state) for each wire at `out`; then the dual is pulled back through the
    diagonal."""
    keep_apart()
    size = width << n
    half = size >> 1
    zero = splat(x.dtype.type(0))
    if phases < 0:
        for b in range(1 << n):
            i = b * width
            u, v = splat(table[0, b]), splat(table[1, b])
            r, s = load(x, dual + i), load(x, dual + size + i)
            store(x, q + i, r * load(x, state + size + i) - s * load(x, state + i))
            store(x, dual + i, u * r + v * s)
            store(x, dual + size + i, u * s - v * r)
    else:
        flip = (1 << n) - 1
        for k in range(1 << (n - 1)):
            c, e = load(x, phases + k * width), load(x, phases + half + k * width)
            for side in range(2):
                b = k ^ mask ^ (flip * side)
                i = b * width
                u, v = splat(table[0, b]), splat(table[1, b])
                r, s = load(x, dual + i), load(x, dual + size + i)
                store(x, q + i, r * load(x, state + size + i) - s * load(x, state + i))
                r, s = u * r + v * s, u * s - v * r
                store(x, dual + i, c * r + e * s)
                store(x, dual + size + i, c * s - e * r)
                e = zero - e
    fold(x, q, n, width, out)


@inner
def start_pull(
    x: Any, state: int, dual: int, n: int, width: int, phases: int, mask: int, q: int, out: int, total: int
) -> None:
    """As `phase_pull` for the first encoding; adds the dual of the common starting state to the vectors at `total`."""
    keep_apart()
    size = width << n
    half = size >> 1
    zero = splat(x.dtype.type(0))
    if phases < 0:
        for k in range(0, 2 * size, width):
            store(x, total + k, load(x, total + k) + load(x, dual + k))
        return
    flip = (1 << n) - 1
    for k in range(1 << (n - 1)):
        c, e = load(x, phases + k * width), load(x, phases + half + k * width)
        for side in range(2):
            i = (k ^ mask ^ (flip * side)) * width
            r, s = load(x, dual + i), load(x, dual + size + i)
            store(x, q + i, r * load(x, state + size + i) - s * load(x, state + i))
            store(x, total + i, load(x, total + i) + c * r + e * s)
            store(x, total + size + i, load(x, total + size + i) + c * s - e * r)
            e = zero - e
    fold(x, q, n, width, out)


@inner
def _sums(x: Any, weight: int, wires: int, width: int, out: int) -> None:
    """sum_j z_j(b) weight_j for the 2^wires states b of some wires."""
    keep_apart()
    store(x, out, splat(x.dtype.type(0)))
    for j in range(wires):
        w = load(x, weight + j * width)
        for k in range((1 << j) - 1, -1, -1):
            a = load(x, out + k * width)
            store(x, out + 2 * k * width, a + w)
            store(x, out + (2 * k + 1) * width, a - w)


@inner
def _mix(x: Any, state: int, dual: int, outer: int, distance: int, width: int, weights: Any) -> None:
    """dual += sum_j weight_j X_j state for a few neighbouring wires."""
    keep_apart()
    span = distance << len(weights)
    for h in range(outer):
        for i in range(h * span, h * span + distance, width):
            mix_block(x, state + i, dual + i, distance, weights)


@inner
def _mixes(x: Any, state: int, dual: int, wires: int, below: int, width: int, weight: int) -> None:
    keep_apart()
    j = 0
    while wires - j >= 4:
        k = weight + j * width
        four = (load(x, k), load(x, k + width), load(x, k + 2 * width), load(x, k + 3 * width))
        _mix(x, state, dual, 1 << j, width << (below + wires - j - 4), width, four)
        j += 4
    while j < wires:
        _mix(x, state, dual, 1 << j, width << (below + wires - j - 1), width, (load(x, weight + j * width),))
        j += 1


@inner
def observe(x: Any, state: int, dual: int, n: int, width: int, weight: int, q: int) -> None:
    """dual = sum_j (a_j Z_j + b_j X_j) state; the vectors a, then b, lie at `weight`."""
    keep_apart()
    size = width << n
    low = min(n, 4)
    inner, high = 1 << low, n - low
    _sums(x, weight + high * width, low, width, q)
    _sums(x, weight, high, width, q + inner * width)
    flip = weight + n * width
    for h in range(1 << high):
        above = load(x, q + (inner + h) * width)
        first = h * inner * width
        for k in range(inner):
            a = above + load(x, q + k * width)
            i = first + k * width
            store(x, dual + i, a * load(x, state + i))
            store(x, dual + size + i, a * load(x, state + size + i))
        for part in range(first, first + 2 * size, size):
            _mixes(x, state + part, dual + part, low, 0, width, flip + high * width)
    for part in range(0, 2 * size, size):
        _mixes(x, state + part, dual + part, high, low, width, flip)
