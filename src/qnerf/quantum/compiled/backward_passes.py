"""Compiled backward passes: adjoint differentiation of each step, in the memory layout of `forward_passes`.

The adjoint state starts as sum_k g_k O_k |psi>, with g_k the gradients of the outputs, and is carried back gate by gate
beside the state. The gradient of an angle whose generator is G / 2 is Im <adjoint| G |psi>. Passes that only read are
arranged so that each chunk of the states is loaded once.
"""

from typing import Any

from qnerf.kernels.simd import inner, keep_apart, load, splat, store
from qnerf.quantum.compiled.forward_passes import walsh, z_sums
from qnerf.quantum.compiled.wire_blocks import add_x_block, gradient_block

LOW = 5  # wires whose amplitudes (2^LOW vectors of two states) stay in the first-level cache


@inner
def _gradient_group(
    x: Any, state: int, adjoint: int, outer: int, distance: int, size: int, width: int, about_x: bool, zeros: Any,
    out: int,
) -> None:  # fmt: skip
    """Adds the gradients of a few neighbouring wires to the vectors at `out`."""
    keep_apart()
    real, imaginary = zeros, zeros
    first, second = (state + size, state) if about_x else (state, state + size)
    # The loops are as in `forward_passes.ry_layer`. For each wire one sum of adjoint_1 state_0 and one of adjoint_0
    # state_1 stay in registers.
    span = distance << (len(zeros) >> 1)
    for h in range(outer):
        for i in range(h * span, h * span + distance, width):
            real = gradient_block(x, first + i, adjoint + i, distance, real)
            imaginary = gradient_block(x, second + i, adjoint + i + size, distance, imaginary)
    sign = splat(x.dtype.type(-1 if about_x else 1))
    for j in range(len(zeros) >> 1):
        value = (real[2 * j] - imaginary[2 * j + 1]) + sign * (imaginary[2 * j] - real[2 * j + 1])
        store(x, out + j * width, load(x, out + j * width) + value)


@inner
def _gradients(
    x: Any, state: int, adjoint: int, wires: int, below: int, size: int, width: int, about_x: bool, out: int
) -> None:
    """Adds the gradients of `wires` neighbouring wires with `below` less significant ones."""
    keep_apart()
    zero = splat(x.dtype.type(0))
    # Three wires at a time, which takes 16 amplitudes of both states and 12 sums; then two or one.
    j = 0
    while wires - j >= 3:
        six = (zero, zero, zero, zero, zero, zero)
        distance = width << (below + wires - j - 3)
        _gradient_group(x, state, adjoint, 1 << j, distance, size, width, about_x, six, out + j * width)
        j += 3
    distance, out = width << below, out + j * width
    if wires - j == 2:
        _gradient_group(x, state, adjoint, 1 << j, distance, size, width, about_x, (zero, zero, zero, zero), out)
    elif wires - j == 1:
        _gradient_group(x, state, adjoint, 1 << j, distance, size, width, about_x, (zero, zero), out)


@inner
def layer_gradients(x: Any, state: int, adjoint: int, n: int, width: int, about_x: bool, out: int) -> None:
    """Gradients of rotations about Y on every wire, or about X, one vector for each wire at `out`.

    Each is a sum over pairs: Re(conj(adjoint_1) state_0 - conj(adjoint_0) state_1) about Y, and
    Im(conj(adjoint_1) state_0 + conj(adjoint_0) state_1) about X.
    """
    keep_apart()
    size = width << n
    zero = splat(x.dtype.type(0))
    for i in range(out, out + n * width, width):
        store(x, i, zero)
    # The last wires first, chunk by chunk: the amplitudes that they couple stay in the first-level cache for all of
    # them. The wires before couple amplitudes of different chunks.
    low = min(n, LOW)
    chunk = width << low
    last = out + (n - low) * width
    for c in range(1 << (n - low)):
        _gradients(x, state + c * chunk, adjoint + c * chunk, low, 0, size, width, about_x, last)
    _gradients(x, state, adjoint, n - low, low, size, width, about_x, out)


@inner
def diagonal_backward(
    x: Any, state: int, adjoint: int, n: int, width: int, table: Any, phases: int, mask: int, even: Any, several: Any,
    q: int, out: int, total: int,
) -> None:  # fmt: skip
    """Gradients of a diagonal for each wire, sum_b z_j Im(conj(adjoint) state); takes the diagonal off the adjoint.

    With `several`, the gradients of all products of Z's instead, at q (see `walsh`). Unless `total` is negative, the
    new adjoint is added to the state there instead.
    """
    keep_apart()
    size = width << n
    half = size >> 1
    zero = splat(x.dtype.type(0))
    # q_b = Im(conj(adjoint_b) state_b) is the gradient of the phase of basis state b. A diagonal does not change it, so
    # the state after the diagonal and the adjoint before it is taken off will do.
    if phases < 0:
        for b in range(1 << n):
            i = b * width
            u, v = splat(table[0, b]), splat(table[1, b])
            r, s = load(x, adjoint + i), load(x, adjoint + size + i)
            store(x, q + i, r * load(x, state + size + i) - s * load(x, state + i))
            store(x, adjoint + i, u * r + v * s)
            store(x, adjoint + size + i, u * s - v * r)
    else:
        flip = (1 << n) - 1
        # The adjoint times the conjugates of the fixed phases u + i v and of the input's c + i e. The second side is
        # the basis state with all bits flipped, whose phase is the conjugate.
        for k in range(1 << (n - 1)):
            c, e = load(x, phases + k * width), load(x, phases + half + k * width)
            for side in range(2):
                b = k ^ mask ^ (flip * side)
                i = b * width
                u, v = splat(table[0, b]), splat(table[1, b])
                r, s = load(x, adjoint + i), load(x, adjoint + size + i)
                store(x, q + i, r * load(x, state + size + i) - s * load(x, state + i))
                r, s = u * r + v * s, u * s - v * r
                r, s = c * r + e * s, c * s - e * r
                if total < 0:
                    store(x, adjoint + i, r)
                    store(x, adjoint + size + i, s)
                else:
                    store(x, total + i, load(x, total + i) + r)
                    store(x, total + size + i, load(x, total + size + i) + s)
                if even is None or not even:
                    e = zero - e
    # The angle of wire j moves the phase of b by -z_j(b) / 2.
    if several is not None and several:
        walsh(x, q, n, width)
        return
    z_sums(x, q, n, width, out)


@inner
def permuted_gradients(x: Any, state: int, adjoint: int, n: int, width: int, moved: Any, q: int, out: int) -> None:
    """Gradients of the phases of each wire behind a permutation, n vectors at `out`, and before it, n more."""
    keep_apart()
    size = width << n
    for i in range(0, size, width):
        r, s = load(x, adjoint + i), load(x, adjoint + size + i)
        store(x, q + i, r * load(x, state + size + i) - s * load(x, state + i))
    # The phase of basis state b behind the permutation is that of moved[b] before it.
    for b in range(1 << n):
        store(x, q + size + moved[b] * width, load(x, q + b * width))
    z_sums(x, q, n, width, out)
    z_sums(x, q + size, n, width, out + n * width)


@inner
def _z_sums_of_weights(x: Any, weight: int, wires: int, width: int, out: int) -> None:
    """sum_j z_j(b) weight_j for the 2^wires basis states b of a few wires."""
    keep_apart()
    # Each wire makes two sums of one, in the same place, from the last to the first.
    store(x, out, splat(x.dtype.type(0)))
    for j in range(wires):
        w = load(x, weight + j * width)
        for k in range((1 << j) - 1, -1, -1):
            a = load(x, out + k * width)
            store(x, out + 2 * k * width, a + w)
            store(x, out + (2 * k + 1) * width, a - w)


@inner
def _add_x_group(x: Any, state: int, adjoint: int, outer: int, distance: int, width: int, weights: Any) -> None:
    """adjoint += sum_j weight_j X_j state for a few neighbouring wires."""
    keep_apart()
    # The loops are as in `forward_passes.ry_layer`.
    span = distance << len(weights)
    for h in range(outer):
        for i in range(h * span, h * span + distance, width):
            add_x_block(x, state + i, adjoint + i, distance, weights)


@inner
def _add_x(x: Any, state: int, adjoint: int, wires: int, below: int, width: int, weight: int) -> None:
    """adjoint += sum_j weight_j X_j state for `wires` neighbouring wires with `below` less significant ones."""
    keep_apart()
    # Four wires at a time, as long as there are as many; then one by one.
    j = 0
    while wires - j >= 4:
        k = weight + j * width
        four = (load(x, k), load(x, k + width), load(x, k + 2 * width), load(x, k + 3 * width))
        _add_x_group(x, state, adjoint, 1 << j, width << (below + wires - j - 4), width, four)
        j += 4
    while j < wires:
        _add_x_group(x, state, adjoint, 1 << j, width << (below + wires - j - 1), width, (load(x, weight + j * width),))
        j += 1


@inner
def apply_observables(x: Any, state: int, adjoint: int, n: int, width: int, weight: int, q: int) -> None:
    """adjoint = sum_j (a_j Z_j + b_j X_j) state; the vectors a, then b, lie at `weight`."""
    keep_apart()
    size = width << n
    # The eigenvalue sum_j a_j z_j(b) is that of the first wires plus that of the last four: two short tables instead of
    # one with an entry for each basis state.
    low = min(n, 4)
    inner, high = 1 << low, n - low
    _z_sums_of_weights(x, weight + high * width, low, width, q)
    _z_sums_of_weights(x, weight, high, width, q + inner * width)
    # For each value of the first wires: the Z part, then the X part of the last four wires while these 16 amplitudes
    # are in the first-level cache.
    flip = weight + n * width
    for h in range(1 << high):
        above = load(x, q + (inner + h) * width)
        first = h * inner * width
        for k in range(inner):
            a = above + load(x, q + k * width)
            i = first + k * width
            store(x, adjoint + i, a * load(x, state + i))
            store(x, adjoint + size + i, a * load(x, state + size + i))
        for part in range(first, first + 2 * size, size):
            _add_x(x, state + part, adjoint + part, low, 0, width, flip + high * width)
    # The X part of the first wires, which couple amplitudes far apart.
    for part in range(0, 2 * size, size):
        _add_x(x, state + part, adjoint + part, high, low, width, flip)
