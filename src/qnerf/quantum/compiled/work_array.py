"""The flat array that a thread works in: where its parts begin, and sums over its vectors."""

from typing import Any, NamedTuple

from qnerf.kernels.simd import inner, keep_apart, splat, store


class Layout(NamedTuple):
    """Where the parts of a thread's flat work array begin. A state takes 2 width 2^n elements."""

    state: int  # one state, or all that the backward pass stores
    adjoint: int  # the adjoint state, and a spare one
    scratch: int  # 2 2^n vectors
    first_adjoint: int  # the adjoint of the state that all samples start from
    phases: int  # phases x 2^n vectors: the input's phases of the basis states
    trig: int  # 2 (M + 1) vectors: cos and sin of half the moving angles, then 1 and 0
    sums: int  # a vector for each tap: gradients of angles, summed over blocks
    inputs: int  # K vectors: gradients of the inputs
    gradients: int  # 2 n vectors: of the operation at hand
    factors: int  # 2 n vectors: of Z and X in the observable
    signs: int  # 4 vectors: 1 and -1, then the sine of a turn and its negative
    end: int


@inner
def layout(start: int, n: int, width: int, states: int, phases: int, moving: int, taps: int, columns: int) -> Layout:
    """The layout from index `start` on, for so many states, rows of phases, moving angles, taps and input columns."""
    size = width << n
    adjoint = start + 2 * states * size
    scratch = adjoint + 4 * size
    first_adjoint = scratch + 2 * size
    phases_ = first_adjoint + 2 * size
    trig = phases_ + phases * size
    sums = trig + 2 * (moving + 1) * width
    inputs = sums + taps * width
    gradients = inputs + columns * width
    factors = gradients + 2 * n * width
    signs = factors + 2 * n * width
    end = signs + 4 * width
    return Layout(start, adjoint, scratch, first_adjoint, phases_, trig, sums, inputs, gradients, factors, signs, end)


class Shape(NamedTuple):
    """Numbers that the size of the work array depends on. Compiled loops take it as it is."""

    n: Any
    width: Any
    states: Any
    columns: Any


@inner
def fill_zero(x: Any, first: int, vectors: int, width: int) -> None:
    """Sets so many vectors from index `first` on to 0."""
    for i in range(first, first + vectors * width, width):
        store(x, i, splat(x.dtype.type(0)))


@inner
def lane_sum(x: Any, first: int, width: int) -> float:
    """The sum of one vector's numbers, in float64."""
    keep_apart()
    value = 0.0
    for i in range(first, first + width):
        value += x[i]
    return value
