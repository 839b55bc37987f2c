"""Compiled passes over the states of a block of samples: rotations about Pauli words, their gradients, expectations.

The memory layout is that of `forward_passes`: `width` samples side by side, amplitude b at `base + b * width`, 2^n
vectors of real parts, then 2^n of imaginary parts.

A row of `words` is (x, z, imaginary, flip), from the word P = i^phase X^x Z^z: `imaginary` is phase mod 2, and `flip`
is phase div 2. P takes amplitude b to place b ^ x, times i^phase (-1)^parity(b & z). It couples pairs: no word here is
of Z's alone. `signs` is the index of two vectors: a value for the sign +1, and its negative.

Each pair is met once, at its member without the highest bit of x. Names with an underscore belong to the other member:
re + i im and re_ + i im_ are amplitudes of the state, u + i v and u_ + i v_ of the adjoint. Where the word is real, not
imaginary, the other member's real and imaginary parts change places, and `t` has the other sign.
"""

from typing import Any

from numba import types

from qnerf.kernels.simd import inner, intrinsic, keep_apart, load, splat, store


@intrinsic
def parity(typing_context: Any, bits: Any) -> Any:
    """Whether an odd number of bits is set."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.and_(builder.ctpop(arguments[0]), arguments[0].type(1))

    return types.int64(types.int64), generate


@inner
def highest_bit(value: int) -> int:
    """The most significant bit of a positive number."""
    bit = 1
    while bit << 1 <= value:
        bit <<= 1
    return bit


@inner
def store_signs(x: Any, signs: int, width: int, value: Any) -> None:
    """The value, then its negative: a sign (0 or 1) times `width` finds the one that it asks for, without a branch."""
    store(x, signs, value)
    store(x, signs + width, splat(x.dtype.type(0)) - value)


@inner
def rotate(x: Any, state: int, n: int, width: int, word: Any, cosine: Any, sines: int) -> None:
    """exp(-i angle/2 P), from the cosine and the `signs` of the sine of half the angle."""
    keep_apart()
    wx, wz, real, flip = word[0], word[1], 1 - word[2], word[3]
    size, half = width << n, highest_bit(wx)
    # `high` runs over the bits above the highest one of wx, b over those below.
    for high in range(0, 1 << n, 2 * half):
        for b in range(high, high + half):
            odd = parity((b ^ wx) & wz) ^ flip
            s, t = load(x, sines + odd * width), load(x, sines + (odd ^ real) * width)
            i = state + b * width
            k, k_ = _other(state + (b ^ wx) * width, size, real)
            re, im, re_, im_ = load(x, i), load(x, i + size), load(x, k), load(x, k_)
            store(x, i, cosine * re + s * re_)
            store(x, i + size, cosine * im + t * im_)
            store(x, k, cosine * re_ - s * re)
            store(x, k_, cosine * im_ - t * im)


@inner
def _other(base: int, size: int, real: int) -> Any:
    """Where the real and the imaginary part of the other member lie; they change places if the word is real."""
    return base + real * size, base + (1 - real) * size


@inner
def rotate_back(
    x: Any, state: int, adjoint: int, n: int, width: int, word: Any, cosine: Any, sines: int, ones: int, out: int
) -> None:
    """Takes the rotation off both states; its gradient Im <adjoint| P |state> goes to the vector at `out`.

    `ones` are the `signs` of 1.
    """
    keep_apart()
    wx, wz, real, flip = word[0], word[1], 1 - word[2], word[3]
    size, half = width << n, highest_bit(wx)
    # The gradient is the same before and after the rotation, which commutes with P. So one pass reads both states, adds
    # to the gradient and turns both states back.
    total = splat(x.dtype.type(0))
    for high in range(0, 1 << n, 2 * half):
        for b in range(high, high + half):
            odd = parity((b ^ wx) & wz) ^ flip
            s, t = load(x, sines + odd * width), load(x, sines + (odd ^ real) * width)
            i, j = state + b * width, adjoint + b * width
            k, k_ = _other(state + (b ^ wx) * width, size, real)
            m, m_ = _other(adjoint + (b ^ wx) * width, size, real)
            re, im, u, v = load(x, i), load(x, i + size), load(x, j), load(x, j + size)
            re_, im_, u_, v_ = load(x, k), load(x, k_), load(x, m), load(x, m_)
            one, other = load(x, ones + odd * width), load(x, ones + (odd ^ real) * width)
            total = total + one * (u * re_ - u_ * re) + other * (v * im_ - v_ * im)
            store(x, i, cosine * re - s * re_)
            store(x, i + size, cosine * im - t * im_)
            store(x, k, cosine * re_ + s * re)
            store(x, k_, cosine * im_ + t * im)
            store(x, j, cosine * u - s * u_)
            store(x, j + size, cosine * v - t * v_)
            store(x, m, cosine * u_ + s * u)
            store(x, m_, cosine * v_ + t * v)
    store(x, out, total)


@inner
def expectation(x: Any, state: int, n: int, width: int, word: Any, ones: int, out: int) -> None:
    """<P>, a vector at `out`."""
    keep_apart()
    wx, wz, real, flip = word[0], word[1], 1 - word[2], word[3]
    size, half = width << n, highest_bit(wx)
    total = splat(x.dtype.type(0))
    for high in range(0, 1 << n, 2 * half):
        for b in range(high, high + half):
            odd = parity((b ^ wx) & wz) ^ flip
            s, t = load(x, ones + odd * width), load(x, ones + (odd ^ real) * width)
            i = state + b * width
            k, k_ = _other(state + (b ^ wx) * width, size, real)
            total = total + s * (load(x, i + size) * load(x, k)) - t * (load(x, i) * load(x, k_))
    # Both members of a pair give the same real part.
    store(x, out, total + total)


@inner
def add_word(x: Any, state: int, adjoint: int, n: int, width: int, word: Any, weights: int) -> None:
    """adjoint += weight P state; `weights` are the `signs` of the weight."""
    keep_apart()
    wx, wz, real, flip = word[0], word[1], 1 - word[2], word[3]
    size, half = width << n, highest_bit(wx)
    for high in range(0, 1 << n, 2 * half):
        for b in range(high, high + half):
            odd = parity((b ^ wx) & wz) ^ flip
            s, t = load(x, weights + odd * width), load(x, weights + (odd ^ real) * width)
            i, j = state + b * width, adjoint + b * width
            k, k_ = _other(state + (b ^ wx) * width, size, real)
            m, m_ = _other(adjoint + (b ^ wx) * width, size, real)
            store(x, j, load(x, j) - t * load(x, k_))
            store(x, j + size, load(x, j + size) + s * load(x, k))
            store(x, m, load(x, m) + s * load(x, i + size))
            store(x, m_, load(x, m_) - t * load(x, i))
