"""Compiled passes over the states of a block of samples: rotations about Pauli words, their gradients, expectations.

The memory layout is that of `forward_passes`: `width` samples side by side, amplitude b at `base + b * width`, 2^n
vectors of real parts, then 2^n of imaginary parts.

A row of `words` is (x, z, imaginary, flip), from the word P = i^phase X^x Z^z: `imaginary` is phase mod 2, and `flip`
is phase div 2. P takes amplitude b to place b ^ x, times i^phase (-1)^parity(b & z). So it couples pairs, or one
amplitude with itself where x = 0. `signs` is the index of two vectors: a value for the sign +1, and its negative.
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
    wx, wz, imaginary, flip = word[0], word[1], word[2], word[3]
    size = width << n
    # A word of Z's alone: every amplitude gets a phase of its own.
    if wx == 0:
        for b in range(1 << n):
            s = load(x, sines + (parity(b & wz) ^ flip) * width)
            i = state + b * width
            re, im = load(x, i), load(x, i + size)
            store(x, i, cosine * re + s * im)
            store(x, i + size, cosine * im - s * re)
        return
    # Else the word couples b with b ^ wx. Each pair is met once, at its member without the highest bit of wx: `high`
    # runs over the bits above it, b over those below. Names with an underscore belong to the other member.
    half = highest_bit(wx)
    for high in range(0, 1 << n, 2 * half):
        for b in range(high, high + half):
            s = load(x, sines + (parity((b ^ wx) & wz) ^ flip) * width)
            i, k = state + b * width, state + (b ^ wx) * width
            re, im = load(x, i), load(x, i + size)
            re_, im_ = load(x, k), load(x, k + size)
            # With an odd number of Y's the word is imaginary, and the rotation -i s P is real.
            if imaginary:
                store(x, i, cosine * re + s * re_)
                store(x, i + size, cosine * im + s * im_)
                store(x, k, cosine * re_ - s * re)
                store(x, k + size, cosine * im_ - s * im)
            else:
                store(x, i, cosine * re + s * im_)
                store(x, i + size, cosine * im - s * re_)
                store(x, k, cosine * re_ + s * im)
                store(x, k + size, cosine * im_ - s * re)


@inner
def rotate_back(
    x: Any, state: int, adjoint: int, n: int, width: int, word: Any, cosine: Any, sines: int, ones: int, out: int
) -> None:
    """Takes the rotation off both states; its gradient Im <adjoint| P |state> goes to the vector at `out`.

    `ones` are the `signs` of 1.
    """
    keep_apart()
    wx, wz, imaginary, flip = word[0], word[1], word[2], word[3]
    size = width << n
    # The gradient is the same before and after the rotation, which commutes with P. So one pass reads both states, adds
    # to the gradient and turns both states back. The loops are as in `rotate`; re + i im is the state, u + i v the
    # adjoint.
    total = splat(x.dtype.type(0))
    if wx == 0:
        for b in range(1 << n):
            odd = (parity(b & wz) ^ flip) * width
            s, one = load(x, sines + odd), load(x, ones + odd)
            i, j = state + b * width, adjoint + b * width
            re, im, u, v = load(x, i), load(x, i + size), load(x, j), load(x, j + size)
            total = total + one * (u * im - v * re)
            store(x, i, cosine * re - s * im)
            store(x, i + size, cosine * im + s * re)
            store(x, j, cosine * u - s * v)
            store(x, j + size, cosine * v + s * u)
        store(x, out, total)
        return
    half = highest_bit(wx)
    for high in range(0, 1 << n, 2 * half):
        for b in range(high, high + half):
            odd = (parity((b ^ wx) & wz) ^ flip) * width
            s, one = load(x, sines + odd), load(x, ones + odd)
            i, k = state + b * width, state + (b ^ wx) * width
            j, m = adjoint + b * width, adjoint + (b ^ wx) * width
            re, im, u, v = load(x, i), load(x, i + size), load(x, j), load(x, j + size)
            re_, im_, u_, v_ = load(x, k), load(x, k + size), load(x, m), load(x, m + size)
            if imaginary:
                total = total + one * ((u * re_ + v * im_) - (u_ * re + v_ * im))
                store(x, i, cosine * re - s * re_)
                store(x, i + size, cosine * im - s * im_)
                store(x, k, cosine * re_ + s * re)
                store(x, k + size, cosine * im_ + s * im)
                store(x, j, cosine * u - s * u_)
                store(x, j + size, cosine * v - s * v_)
                store(x, m, cosine * u_ + s * u)
                store(x, m + size, cosine * v_ + s * v)
            else:
                total = total + one * ((u * im_ - v * re_) + (u_ * im - v_ * re))
                store(x, i, cosine * re - s * im_)
                store(x, i + size, cosine * im + s * re_)
                store(x, k, cosine * re_ - s * im)
                store(x, k + size, cosine * im_ + s * re)
                store(x, j, cosine * u - s * v_)
                store(x, j + size, cosine * v + s * u_)
                store(x, m, cosine * u_ - s * v)
                store(x, m + size, cosine * v_ + s * u)
    store(x, out, total)


@inner
def expectation(x: Any, state: int, n: int, width: int, word: Any, ones: int, out: int) -> None:
    """<P>, a vector at `out`."""
    keep_apart()
    wx, wz, imaginary, flip = word[0], word[1], word[2], word[3]
    size = width << n
    # The loops are as in `rotate`.
    total = splat(x.dtype.type(0))
    if wx == 0:
        for b in range(1 << n):
            i = state + b * width
            re, im = load(x, i), load(x, i + size)
            total = total + load(x, ones + (parity(b & wz) ^ flip) * width) * (re * re + im * im)
        store(x, out, total)
        return
    half = highest_bit(wx)
    for high in range(0, 1 << n, 2 * half):
        for b in range(high, high + half):
            one = load(x, ones + (parity((b ^ wx) & wz) ^ flip) * width)
            i, k = state + b * width, state + (b ^ wx) * width
            re, im, re_, im_ = load(x, i), load(x, i + size), load(x, k), load(x, k + size)
            product = im * re_ - re * im_ if imaginary else re * re_ + im * im_
            total = total + one * product
    # Both members of a pair give the same real part.
    store(x, out, total + total)


@inner
def add_word(x: Any, state: int, adjoint: int, n: int, width: int, word: Any, weights: int) -> None:
    """adjoint += weight P state; `weights` are the `signs` of the weight."""
    keep_apart()
    wx, wz, imaginary, flip = word[0], word[1], word[2], word[3]
    size = width << n
    # The loops are as in `rotate`.
    if wx == 0:
        for b in range(1 << n):
            w = load(x, weights + (parity(b & wz) ^ flip) * width)
            i, j = state + b * width, adjoint + b * width
            store(x, j, load(x, j) + w * load(x, i))
            store(x, j + size, load(x, j + size) + w * load(x, i + size))
        return
    half = highest_bit(wx)
    for high in range(0, 1 << n, 2 * half):
        for b in range(high, high + half):
            w = load(x, weights + (parity((b ^ wx) & wz) ^ flip) * width)
            i, k = state + b * width, state + (b ^ wx) * width
            j, m = adjoint + b * width, adjoint + (b ^ wx) * width
            re, im, re_, im_ = load(x, i), load(x, i + size), load(x, k), load(x, k + size)
            if imaginary:
                store(x, j, load(x, j) - w * im_)
                store(x, j + size, load(x, j + size) + w * re_)
                store(x, m, load(x, m) + w * im)
                store(x, m + size, load(x, m + size) - w * re)
            else:
                store(x, j, load(x, j) + w * re_)
                store(x, j + size, load(x, j + size) + w * im_)
                store(x, m, load(x, m) + w * re)
                store(x, m + size, load(x, m + size) + w * im)
