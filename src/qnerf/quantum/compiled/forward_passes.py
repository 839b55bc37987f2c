"""Compiled forward passes: each applies one block of a program to the states of a block of samples.

A block holds as many samples as fit one machine vector (`simd.lanes`), side by side. Amplitude b of the block is the
vector at `base + b * width` of a flat array x. A state is 2^n vectors of real parts, then 2^n of imaginary parts.
Wire j is bit n - 1 - j of b. Up to about 10 wires everything stays in the first two cache levels from the first gate to
the last.

RY layers are applied as (1, -t; t, 1) with t = tan(angle / 2), |t| <= 1. That is two multiply-adds a pair instead of
four operations. The missing cosines are factors of the diagonal before (`tables.bind`).
"""

from typing import Any

from qnerf.kernels.simd import inner, keep_apart, load, splat, store
from qnerf.quantum.compiled.wire_blocks import ry_block, x_block
from qnerf.quantum.compiled.word_passes import parity


@inner
def _ry_group(x: Any, source: int, target: int, outer: int, distance: int, width: int, tangents: Any) -> None:
    """`ry_layer` for a few neighbouring wires: those with `outer` = 2^j basis states of the j wires before them."""
    keep_apart()
    # The k wires of the group couple 2^k amplitudes that lie `distance` apart. The outer loop goes over the values of
    # the wires before the group, the inner one over those after it, which lie side by side.
    span = distance << len(tangents)
    for h in range(outer):
        for i in range(h * span, h * span + distance, width):
            ry_block(x, source + i, target + i, distance, tangents)


@inner
def ry_layer(x: Any, source: int, target: int, n: int, width: int, tangents: Any, forward: bool) -> None:
    """(1, -t; t, 1) on every wire, from the state at `source` to `target`; the transpose if not `forward`."""
    keep_apart()
    size = width << n
    t = tangents if forward else -tangents
    # The rotations are real, so the real and the imaginary parts go through separately. Four wires at a time: their 16
    # amplitudes fit the vector registers, and the state is read and written once for all four. The first group reads
    # the source, the others work in place.
    for part in range(0, 2 * size, size):
        read, write = source + part, target + part
        j = 0
        while n - j >= 4:
            four = (splat(t[j]), splat(t[j + 1]), splat(t[j + 2]), splat(t[j + 3]))
            _ry_group(x, read, write, 1 << j, width << (n - j - 4), width, four)
            read = write
            j += 4
        if n - j >= 2:
            _ry_group(x, read, write, 1 << j, width << (n - j - 2), width, (splat(t[j]), splat(t[j + 1])))
            read = write
            j += 2
        if n - j == 1:
            _ry_group(x, read, write, 1 << j, width, width, (splat(t[j]),))


@inner
def input_phases(x: Any, out: int, n: int, width: int, trig: int, singles: Any) -> None:
    """Phases prod_j (c_j - i s_j z_j) of the basis states whose first bit is 0: real, then imaginary parts at `out`.

    The cosine and the sine of wire j are the vectors number 2 singles[j] and the next one at `trig`. The phase of a
    basis state with first bit 1 is the conjugate of the one with all bits flipped.
    """
    keep_apart()
    half = (width << n) >> 1
    # Wire 0 has bit 0: its factor is c - i s.
    first = trig + 2 * singles[0] * width
    store(x, out, load(x, first))
    store(x, out + half, splat(x.dtype.type(0)) - load(x, first + width))
    for j in range(1, n):
        c, s = load(x, trig + 2 * singles[j] * width), load(x, trig + (2 * singles[j] + 1) * width)
        # Each further wire makes two phases of one, in the same place. From the last to the first, so that none is
        # overwritten before it was read.
        for k in range((1 << (j - 1)) - 1, -1, -1):
            a, b = load(x, out + k * width), load(x, out + half + k * width)
            ac, bs, bc, asine = a * c, b * s, b * c, a * s
            store(x, out + 2 * k * width, ac + bs)  # bit 0: times c - i s
            store(x, out + half + 2 * k * width, bc - asine)
            store(x, out + (2 * k + 1) * width, ac - bs)
            store(x, out + half + (2 * k + 1) * width, bc + asine)


@inner
def product_phases(x: Any, out: int, n: int, width: int, cosine: int, sine: int, mask: int) -> None:
    """Multiplies the phases at `out` by c - i s z, where z is the product of the Z's of `mask`."""
    keep_apart()
    half = (width << n) >> 1
    zero = splat(x.dtype.type(0))
    c = load(x, cosine)
    for k in range(1 << (n - 1)):
        s = load(x, sine)
        if parity(k & mask):
            s = zero - s
        a, b = load(x, out + k * width), load(x, out + half + k * width)
        store(x, out + k * width, a * c + b * s)
        store(x, out + half + k * width, b * c - a * s)


@inner
def start(x: Any, target: int, n: int, width: int, psi: Any, phases: int, mask: int, even: Any) -> None:
    """The same state psi (2, 2^n) for every sample, times the input's phases unless `phases` is negative."""
    keep_apart()
    size = width << n
    half = size >> 1
    # Without an input every sample starts from the same amplitudes.
    if phases < 0:
        for b in range(1 << n):
            store(x, target + b * width, splat(psi[0, b]))
            store(x, target + size + b * width, splat(psi[1, b]))
        return
    flip = (1 << n) - 1
    # A phase c + i s of half of the basis states, and its conjugate for the states with all bits flipped; the phase
    # itself, if it is of even products of Z. The Pauli frame has flipped the bits in `mask`.
    for k in range(1 << (n - 1)):
        c, s = load(x, phases + k * width), load(x, phases + half + k * width)
        b = k ^ mask
        u, v = splat(psi[0, b]), splat(psi[1, b])
        store(x, target + b * width, c * u - s * v)
        store(x, target + size + b * width, c * v + s * u)
        if even is not None and even:
            s = splat(x.dtype.type(0)) - s
        b = b ^ flip
        u, v = splat(psi[0, b]), splat(psi[1, b])
        store(x, target + b * width, c * u + s * v)
        store(x, target + size + b * width, c * v - s * u)


@inner
def diagonal(
    x: Any, target: int, n: int, width: int, table: Any, phases: int, mask: int, even: Any, forward: bool
) -> None:
    """Multiplies the state by the diagonal `table` (2, 2^n) and, unless `phases` is negative, by the input's phases.

    By the conjugates of both if not `forward`.
    """
    keep_apart()
    size = width << n
    half = size >> 1
    zero = splat(x.dtype.type(0))
    # The fixed phases u + i v are the same for all samples of the block.
    if phases < 0:
        for b in range(1 << n):
            u, v = splat(table[0, b]), splat(table[1, b])
            if not forward:
                v = zero - v
            r, i = load(x, target + b * width), load(x, target + size + b * width)
            store(x, target + b * width, u * r - v * i)
            store(x, target + size + b * width, u * i + v * r)
        return
    flip = (1 << n) - 1
    # Both products in one pass over the state. The input's phases come in pairs, as in `start`.
    for k in range(1 << (n - 1)):
        c, s = load(x, phases + k * width), load(x, phases + half + k * width)
        if not forward:
            s = zero - s
        for side in range(2):
            b = k ^ mask ^ (flip * side)
            p = target + b * width
            u, v = splat(table[0, b]), splat(table[1, b])
            if not forward:
                v = zero - v
            r, i = load(x, p), load(x, p + size)
            r, i = u * r - v * i, u * i + v * r
            store(x, p, c * r - s * i)
            store(x, p + size, c * i + s * r)
            if even is None or not even:
                s = zero - s


@inner
def walsh(x: Any, q: int, n: int, width: int) -> None:
    """q becomes sum_b z_m(b) q_b for the product of Z's of each mask m, in place."""
    keep_apart()
    for j in range(n):
        half = width << j
        for h in range(q, q + (width << n), 2 * half):
            for i in range(h, h + half, width):
                a, b = load(x, i), load(x, i + half)
                store(x, i, a + b)
                store(x, i + half, a - b)


@inner
def z_sums(x: Any, q: int, n: int, width: int, out: int) -> None:
    """For each wire sum_b z_j(b) q_b, a vector at `out`: of probabilities q these are <Z>. Overwrites q."""
    keep_apart()
    zero = splat(x.dtype.type(0))
    # Wire by wire, the most significant first: the sum of the first half less that of the second. Then the two halves
    # are added up, and the next wire needs half as many: 2^n additions for all wires instead of n 2^n.
    for j in range(n):
        half = width << (n - j - 1)
        s0, s1, s2, s3 = zero, zero, zero, zero
        i = q
        # Four sums at once, because each addition has to wait for the last one into the same sum.
        while i + 3 * width < q + half:
            a0, a1, a2, a3 = load(x, i), load(x, i + width), load(x, i + 2 * width), load(x, i + 3 * width)
            k = i + half
            b0, b1, b2, b3 = load(x, k), load(x, k + width), load(x, k + 2 * width), load(x, k + 3 * width)
            s0, s1, s2, s3 = s0 + (a0 - b0), s1 + (a1 - b1), s2 + (a2 - b2), s3 + (a3 - b3)
            store(x, i, a0 + b0)
            store(x, i + width, a1 + b1)
            store(x, i + 2 * width, a2 + b2)
            store(x, i + 3 * width, a3 + b3)
            i += 4 * width
        # What is left over, fewer than four.
        while i < q + half:
            a0, b0 = load(x, i), load(x, i + half)
            s0 = s0 + (a0 - b0)
            store(x, i, a0 + b0)
            i += width
        store(x, out + j * width, (s0 + s1) + (s2 + s3))


@inner
def probabilities(x: Any, state: int, n: int, width: int, q: int) -> None:
    """Probabilities of the basis states, 2^n vectors at q."""
    keep_apart()
    size = width << n
    for i in range(0, size, width):
        r, s = load(x, state + i), load(x, state + size + i)
        store(x, q + i, r * r + s * s)


@inner
def permute(x: Any, source: int, target: int, n: int, width: int, moved: Any, table: Any, forward: bool) -> None:
    """target[b] = table[b] source[moved[b]]; the adjoint of this if not `forward`."""
    keep_apart()
    size = width << n
    for b in range(1 << n):
        a, c, u, v = b * width, moved[b] * width, splat(table[0, b]), splat(table[1, b])
        if not forward:
            a, c, v = c, a, splat(x.dtype.type(0)) - v
        r, i = load(x, source + c), load(x, source + size + c)
        store(x, target + a, u * r - v * i)
        store(x, target + size + a, u * i + v * r)


@inner
def _x_group(x: Any, state: int, outer: int, distance: int, size: int, width: int, zeros: Any, out: int) -> None:
    """`x_expectations` of a few neighbouring wires."""
    keep_apart()
    real, imaginary = zeros, zeros
    # <X> of a wire is twice the sum over pairs a, b that differ in it of Re(conj(a) b). Two sums for each wire and part
    # stay in registers throughout; they are added up at the end.
    span = distance << (len(zeros) >> 1)
    for h in range(outer):
        for i in range(state + h * span, state + h * span + distance, width):
            real = x_block(x, i, distance, real)
            imaginary = x_block(x, i + size, distance, imaginary)
    two = splat(x.dtype.type(2))
    for j in range(len(zeros) >> 1):
        value = (real[2 * j] + real[2 * j + 1]) + (imaginary[2 * j] + imaginary[2 * j + 1])
        store(x, out + j * width, two * value)


@inner
def x_expectations(x: Any, state: int, n: int, width: int, out: int) -> None:
    """<X> of every wire, a vector at `out`."""
    keep_apart()
    size = width << n
    zero = splat(x.dtype.type(0))
    # Three wires at a time: 8 amplitudes, and 6 sums for each of real and imaginary parts.
    j = 0
    while n - j >= 3:
        six = (zero, zero, zero, zero, zero, zero)
        _x_group(x, state, 1 << j, width << (n - j - 3), size, width, six, out + j * width)
        j += 3
    while j < n:
        _x_group(x, state, 1 << j, width << (n - j - 1), size, width, (zero, zero), out + j * width)
        j += 1
