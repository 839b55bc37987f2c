"""Compiled sweeps of the Pauli form over the samples of a step: one through the circuit, one back.

The backward sweep runs each block again. It then takes the rotations off the state and the adjoint state
sum_k g_k O_k |psi> one after the other, so memory does not depend on the number of gates.

Shapes: n wires; `width` samples in a block.
"""

from typing import Any, NamedTuple

import numpy as np

from qnerf.kernels.jit import jit
from qnerf.kernels.simd import inner, keep_apart, load, splat, start_of_line, store
from qnerf.quantum.compiled import pauli_passes


class PauliArrays(NamedTuple):
    """A Pauli form. Compiled loops take it as it is."""

    rotations: Any  # (rotations, 6) a word (see `pauli_passes`), 1 if its angle moves with the input, its column there
    words: Any  # (words, 4) that are measured
    tables: Any  # (tables, 2^n) outcomes of basis states
    outcomes: Any  # (tables + 1,) where the outcomes of each table begin


class StepArrays(NamedTuple):
    """What a step sets. Compiled loops take it as it is."""

    count: Any  # leading rotations that no input moves, which are in `shared` already
    fixed: Any  # (2, fixed rotations) cos and sin of half the angles that no input moves
    trig: Any  # (blocks, 2, moving rotations, width) the same of the others
    shared: Any  # (2, 2^n) the state after the first `count` rotations
    starts: Any  # (blocks, 2, 2^n, width) another one for each sample; or no blocks


@inner
def _ready(x: Any, at: int, width: int, row: Any, fixed: Any, trig: Any) -> Any:
    """Stores the `signs` of the sine of half a rotation's angle at `at`; returns the cosine."""
    column = row[5]
    # An angle that moves with the input has its cosine and sine for each sample; a fixed one is the same for all.
    if row[4]:
        for i in range(width):
            x[at + i] = trig[0, column, i]
            x[at + width + i] = trig[1, column, i]
        cosine, sine = load(x, at), load(x, at + width)
    else:
        cosine, sine = splat(fixed[0, column]), splat(fixed[1, column])
    pauli_passes.store_signs(x, at, width, sine)
    return cosine


@inner
def _forward(
    x: Any, state: int, spare: int, n: int, width: int, rotations: Any, first: int, fixed: Any, trig: Any
) -> None:
    """The rotations from `first` on, in place."""
    keep_apart()
    for r in range(first, len(rotations)):
        cosine = _ready(x, spare, width, rotations[r], fixed, trig)
        pauli_passes.rotate(x, state, n, width, rotations[r], cosine, spare)


@inner
def _set_shared(x: Any, state: int, n: int, width: int, shared: Any) -> None:
    """The same state (2, 2^n) for all samples of the block."""
    keep_apart()
    size = width << n
    for b in range(1 << n):
        store(x, state + b * width, splat(shared[0, b]))
        store(x, state + size + b * width, splat(shared[1, b]))


@inner
def _set(x: Any, state: int, n: int, width: int, block: Any) -> None:
    """A state for each sample, from `block` (2, 2^n, width)."""
    keep_apart()
    size = width << n
    for part in range(2):
        for b in range(1 << n):
            for i in range(width):
                x[state + part * size + b * width + i] = block[part, b, i]


@inner
def _get(x: Any, state: int, n: int, width: int, factor: Any, block: Any) -> None:
    """A factor times the states goes to `block` (2, 2^n, width)."""
    keep_apart()
    size = width << n
    for part in range(2):
        for b in range(1 << n):
            for i in range(width):
                block[part, b, i] = factor * x[state + part * size + b * width + i]


@jit
def prepare(rotations: Any, count: int, n: int, width: int, fixed: Any, shared: Any) -> None:
    """Applies the first `count` rotations, which no input moves, to the state `shared` (2, 2^n)."""
    size = width << n
    # A block whose samples are all the same; the first lane is read at the end.
    x = np.zeros(2 * size + 2 * width + 64, fixed.dtype)
    state = start_of_line(x)
    _set_shared(x, state, n, width, shared)
    _forward(x, state, state + 2 * size, n, width, rotations[:count], 0, fixed, np.zeros((2, 0, width), fixed.dtype))
    for b in range(1 << n):
        shared[0, b], shared[1, b] = x[state + b * width], x[state + size + b * width]


@jit
def prepare_backward(
    rotations: Any, count: int, n: int, width: int, fixed: Any, shared: Any, adjoint: Any, sums: Any
) -> None:
    """Adds the gradients of the first `count` rotations to `sums`, from the state after them and its adjoint.

    `adjoint` becomes the adjoint of the state before them.
    """
    size = width << n
    # As in `prepare`, with the adjoint beside the state. Both are carried back rotation by rotation.
    x = np.zeros(4 * size + 5 * width + 64, fixed.dtype)
    state = start_of_line(x)
    other, spare = state + 2 * size, state + 4 * size
    ones, out = spare + 2 * width, spare + 4 * width
    trig = np.zeros((2, 0, width), fixed.dtype)
    pauli_passes.store_signs(x, ones, width, splat(fixed.dtype.type(1)))
    _set_shared(x, state, n, width, shared)
    _set_shared(x, other, n, width, adjoint)
    for r in range(count - 1, -1, -1):
        cosine = _ready(x, spare, width, rotations[r], fixed, trig)
        pauli_passes.rotate_back(x, state, other, n, width, rotations[r], cosine, spare, ones, out)
        sums[rotations[r, 5]] += x[out]
    for b in range(1 << n):
        adjoint[0, b], adjoint[1, b] = x[other + b * width], x[other + size + b * width]


@jit
def forward(
    first: int, last: int, parts: int, n: int, width: int, form: PauliArrays, step: StepArrays, out: Any
) -> None:
    """The blocks of samples in the parts first..last; out (blocks, words and outcomes, width)."""
    rotations, words, tables, outcomes = form
    count, fixed, trig, shared, starts = step
    blocks = trig.shape[0]
    size = width << n
    # The work array: the state, two vectors for the sine of a rotation, two for 1 and -1, one for a value.
    x = np.zeros(2 * size + 5 * width + 64, fixed.dtype)
    state = start_of_line(x)
    spare = state + 2 * size
    ones, value = spare + 2 * width, spare + 4 * width
    pauli_passes.store_signs(x, ones, width, splat(fixed.dtype.type(1)))
    for block in range(blocks * first // parts, blocks * last // parts):
        if len(starts):
            _set(x, state, n, width, starts[block])
        else:
            _set_shared(x, state, n, width, shared)
        _forward(x, state, spare, n, width, rotations, count, fixed, trig[block])
        for k in range(len(words)):
            pauli_passes.expectation(x, state, n, width, words[k], ones, value)
            for i in range(width):
                out[block, k, i] = x[value + i]
        # Probabilities: each basis state counts for one outcome of each table.
        for row in range(len(words), out.shape[1]):
            for i in range(width):
                out[block, row, i] = 0
        for t in range(len(tables)):
            for b in range(1 << n):
                row = len(words) + outcomes[t] + tables[t, b]
                for i in range(width):
                    re, im = x[state + b * width + i], x[state + size + b * width + i]
                    out[block, row, i] += re * re + im * im


@inner
def _apply_observables(
    x: Any, state: int, adjoint: int, spare: int, n: int, width: int, form: PauliArrays, gradient: Any
) -> None:
    """adjoint = sum_k gradient_k O_k state."""
    keep_apart()
    _, words, tables, outcomes = form
    size = width << n
    for i in range(adjoint, adjoint + 2 * size, width):
        store(x, i, splat(x.dtype.type(0)))
    # Words, then probabilities, whose operators project on the basis states of an outcome.
    for k in range(len(words)):
        for i in range(width):
            x[spare + i] = gradient[k, i]
        pauli_passes.store_signs(x, spare, width, load(x, spare))
        pauli_passes.add_word(x, state, adjoint, n, width, words[k], spare)
    for t in range(len(tables)):
        for b in range(1 << n):
            row = len(words) + outcomes[t] + tables[t, b]
            for i in range(width):
                g, j = gradient[row, i], b * width + i
                x[adjoint + j] += g * x[state + j]
                x[adjoint + size + j] += g * x[state + size + j]


@jit
def backward(
    first: int, last: int, parts: int, n: int, width: int, form: PauliArrays, step: StepArrays, gradient: Any,
    moving_out: Any, sums_out: Any, adjoint_out: Any, starts_out: Any,
) -> None:  # fmt: skip
    """Gradients, given the gradients of the values: `gradient` (blocks, words and outcomes, width).

    moving_out (blocks, moving rotations, width): of the angles that move with the input
    sums_out (parts, fixed rotations): of the others, summed over each part
    adjoint_out (parts, 2, 2^n): adjoint of `shared`, summed over each part
    starts_out (blocks, 2, 2^n, width): gradients of `starts`
    """
    rotations = form.rotations
    count, fixed, trig, shared, starts = step
    blocks = trig.shape[0]
    size = width << n
    # The work array: state, adjoint, the adjoints summed over the part; then the vectors of `forward`.
    x = np.zeros(6 * size + 5 * width + 64, fixed.dtype)
    state = start_of_line(x)
    adjoint, total, spare = state + 2 * size, state + 4 * size, state + 6 * size
    ones, out = spare + 2 * width, spare + 4 * width
    pauli_passes.store_signs(x, ones, width, splat(fixed.dtype.type(1)))
    # A part is a fixed range of blocks with sums of its own, so that no bit depends on the number of threads.
    for part in range(first, last):
        for i in range(total, total + 2 * size, width):
            store(x, i, splat(x.dtype.type(0)))
        for block in range(blocks * part // parts, blocks * (part + 1) // parts):
            if len(starts):
                _set(x, state, n, width, starts[block])
            else:
                _set_shared(x, state, n, width, shared)
            _forward(x, state, spare, n, width, rotations, count, fixed, trig[block])
            _apply_observables(x, state, adjoint, spare, n, width, form, gradient[block])
            # The rotations back to those that run once a step. Each leaves its gradient at `out`, one lane a sample.
            for r in range(len(rotations) - 1, count - 1, -1):
                cosine = _ready(x, spare, width, rotations[r], fixed, trig[block])
                pauli_passes.rotate_back(x, state, adjoint, n, width, rotations[r], cosine, spare, ones, out)
                column = rotations[r, 5]
                if rotations[r, 4]:
                    for i in range(width):
                        moving_out[block, column, i] = x[out + i]
                else:
                    for i in range(width):
                        sums_out[part, column] += x[out + i]
            if len(starts):
                _get(x, adjoint, n, width, fixed.dtype.type(2), starts_out[block])
            for i in range(0, 2 * size, width):
                store(x, total + i, load(x, total + i) + load(x, adjoint + i))
        # The lanes are samples; they are added up once a part.
        for side in range(2):
            for b in range(1 << n):
                value = 0.0
                for i in range(width):
                    value += x[total + side * size + b * width + i]
                adjoint_out[part, side, b] = value
