"""Compiled sweeps over the samples of a step: one through the circuit, one back; `engine` gives them their arrays.

The forward sweep takes each block of samples through the circuit. The backward sweep runs each block again and stores
the state before each RY layer and each permutation (in cache, a few hundred KiB). Then it carries the adjoint state
sum_k g_k O_k |psi> back operation by operation, so that every gradient is one inner product of the two states. Where
the stored states would be too many, the operations are taken off the state, too.

Shapes: n wires; `width` samples in a block; M moving angles; K columns of the input.
"""

from typing import Any, NamedTuple

import numpy as np

from qnerf.kernels.jit import jit
from qnerf.kernels.simd import inner, keep_apart, load, splat, start_of_line, store
from qnerf.quantum.compiled import backward_passes, forward_passes, word_passes
from qnerf.quantum.compiled.tables import (
    CODE,
    COLUMN,
    DIAGONAL,
    EVEN,
    FIRST,
    LAST,
    MOVED,
    PERMUTATION,
    PHASES,
    RY,
    SEVERAL,
    SOURCE,
    START,
    START_EACH,
    TABLE,
    TILTS,
    TURN,
    UNDO,
    Extra,
    Measurement,
    Tables,
)
from qnerf.quantum.compiled.work_array import Layout, Shape, fill_zero, lane_sum, layout

FORWARD, BACK = True, False
ABOUT_X, ABOUT_Y = True, False


class Moving(NamedTuple):
    """What a step needs of the input. Compiled loops take it as it is."""

    trig: Any  # (blocks, 2, M, width) cos and sin of half the moving angles
    singles: Any  # (phases, n) the moving angle of each wire; M for none


@inner
def _turn_cosine(x: Any, at: Layout, width: int, turn: Any, extra: Extra) -> Any:
    """Stores the sine of half a turn's angle and its negative; returns the cosine."""
    # An angle that moves with the input has its cosine and sine for each sample; a fixed one is the same for all.
    sines = at.signs + 2 * width
    if turn[4]:
        cosine, sine = load(x, at.trig + 2 * turn[5] * width), load(x, at.trig + (2 * turn[5] + 1) * width)
    else:
        cosine, sine = splat(extra.fixed[0, turn[5]]), splat(extra.fixed[1, turn[5]])
    word_passes.store_signs(x, sines, width, sine)
    return cosine


@inner
def _flag(value: int, extra: Any) -> Any:
    """Whether a flag is set; None, for which loops are compiled without it, where no operation has it."""
    if extra is None:
        return None
    return value == 1


@inner
def _forward(
    x: Any, at: Layout, n: int, width: int, operations: Any, masks: Any, tables: Tables, psi: Any, extra: Any,
    block: int, store_states: bool,
) -> int:  # fmt: skip
    """Runs the operations and returns where the final state lies.

    With `store_states` the state before each layer and each permutation stays in the work array.
    """
    keep_apart()
    tangents, diagonals, permutations = tables.tangents, tables.diagonals, tables.permutations
    pair = 2 * (width << n)
    here = at.state
    # Diagonals and turns work in place. With `store_states` every other operation writes the state behind the one that
    # it reads, so that the states stay in the work array in order.
    for o in range(len(operations)):
        code, row, phases = operations[o, CODE], operations[o, TABLE], operations[o, PHASES]
        p = -1 if phases < 0 else at.phases + phases * (pair >> 1)
        after = here + pair if store_states else here
        even = _flag(operations[o, EVEN], extra)
        if code == START:
            forward_passes.start(x, here, n, width, psi, p, masks[o], even)
        elif code == DIAGONAL:
            forward_passes.diagonal(x, here, n, width, diagonals[row], p, masks[o], even, FORWARD)
        elif code == RY:
            forward_passes.ry_layer(x, here, after, n, width, tangents[row], FORWARD)
            here = after
        elif code == PERMUTATION:
            # A permutation cannot work in place: two states take turns.
            if not store_states:
                after = at.state + pair if here == at.state else at.state
            moved = permutations[operations[o, MOVED]]
            forward_passes.permute(x, here, after, n, width, moved, diagonals[row], FORWARD)
            here = after
        if extra is not None:
            if code == TURN:
                cosine = _turn_cosine(x, at, width, extra.turns[row], extra)
                word_passes.rotate(x, here, n, width, extra.turns[row], cosine, at.signs + 2 * width)
            elif code == START_EACH:
                for part in range(2):
                    for b in range(1 << n):
                        for i in range(width):
                            x[here + ((part << n) + b) * width + i] = extra.starts[block, part, b, i]
    return here


@inner
def _gradients(
    x: Any, at: Layout, operation: Any, taps: Any, factors: Any, first: int, square: Any, width: int
) -> None:
    """Adds the gradients at `first` to the sums of the taps, and to those of the input."""
    keep_apart()
    for k in range(operation[FIRST], operation[LAST]):
        value = load(x, first + taps[k, SOURCE] * width)
        if square != 1:
            value = splat(x.dtype.type(square)) * value
        total = at.sums + k * width
        store(x, total, load(x, total) + value)
        if taps[k, COLUMN] >= 0:
            total = at.inputs + taps[k, COLUMN] * width
            store(x, total, load(x, total) + splat(factors[k]) * value)


@inner
def _backward(
    x: Any, at: Layout, n: int, width: int, operations: Any, masks: Any, squares: Any, taps: Any, factors: Any,
    tables: Tables, extra: Any, here: int, stored: bool,
) -> None:  # fmt: skip
    """Carries the adjoint state back through the operations; `here` is the last state.

    Adds to the work array's `sums`, `first_adjoint` and `inputs`.
    """
    keep_apart()
    tangents, diagonals, permutations = tables.tangents, tables.diagonals, tables.permutations
    pair = 2 * (width << n)
    adjoint, spare, scratch, d = at.adjoint, at.adjoint + pair, at.scratch, at.gradients
    # Each operation is taken off the adjoint, and its gradients are inner products of the adjoint with the state.
    # Layers use the state before them, diagonals and turns the one after them.
    for o in range(len(operations) - 1, -1, -1):
        code, row, phases = operations[o, CODE], operations[o, TABLE], operations[o, PHASES]
        p = -1 if phases < 0 else at.phases + phases * (pair >> 1)
        even, several = _flag(operations[o, EVEN], extra), _flag(operations[o, SEVERAL], extra)
        first, square = scratch if operations[o, SEVERAL] else d, 1.0
        # A state that was not stored lacks the cosines of a layer that was taken off it, or has them twice.
        if not stored:
            square = squares[o]
        if code == RY:
            forward_passes.ry_layer(x, adjoint, adjoint, n, width, tangents[row], BACK)
            if stored:
                here -= pair
            else:
                forward_passes.ry_layer(x, here, here, n, width, tangents[row], BACK)
            backward_passes.layer_gradients(x, here, adjoint, n, width, ABOUT_Y, d)
        elif code == TILTS:
            if not masks[o]:
                continue
            backward_passes.layer_gradients(x, here, adjoint, n, width, ABOUT_X, d)
        elif code == PERMUTATION:
            moved = permutations[operations[o, MOVED]]
            if operations[o, LAST] > operations[o, FIRST]:
                backward_passes.permuted_gradients(x, here, adjoint, n, width, moved, scratch, d)
            forward_passes.permute(x, adjoint, spare, n, width, moved, diagonals[row], BACK)
            adjoint, spare = spare, adjoint
            if stored:
                here -= pair
            else:
                other = at.state + pair if here == at.state else at.state
                forward_passes.permute(x, here, other, n, width, moved, diagonals[row], BACK)
                here = other
        elif code == DIAGONAL:
            backward_passes.diagonal_backward(
                x, here, adjoint, n, width, diagonals[row], p, masks[o], even, several, scratch, d, -1
            )
            if operations[o, UNDO] or not stored:
                forward_passes.diagonal(x, here, n, width, diagonals[row], p, masks[o], even, BACK)
                if stored and squares[o] != 1:
                    factor = splat(x.dtype.type(1.0 / squares[o]))
                    for i in range(here, here + pair, width):
                        store(x, i, factor * load(x, i))
        elif code == START and row >= 0:
            total = at.first_adjoint
            backward_passes.diagonal_backward(
                x, here, adjoint, n, width, diagonals[row], p, masks[o], even, several, scratch, d, total
            )
        elif code == START:
            for i in range(0, pair, width):
                store(x, at.first_adjoint + i, load(x, at.first_adjoint + i) + load(x, adjoint + i))
        elif extra is not None and code == TURN:
            cosine, sines = _turn_cosine(x, at, width, extra.turns[row], extra), at.signs + 2 * width
            word_passes.rotate_back(x, here, adjoint, n, width, extra.turns[row], cosine, sines, at.signs, d)
        if operations[o, LAST] > operations[o, FIRST]:
            _gradients(x, at, operations[o], taps, factors, first, square, width)
    if adjoint != at.adjoint:
        for i in range(0, pair, width):
            store(x, at.adjoint + i, load(x, adjoint + i))


@inner
def _prepared(
    x: Any, at: Layout, n: int, width: int, once: int, operations: Any, tables: Tables, extra: Any, first: Any
) -> Any:
    """The state (2, 2^n) before the first data: `operations[:once]` on the state `first`.

    With the fixed phases of the next operation, if it begins with phases.
    """
    psi = np.empty_like(first)
    here = _forward(x, at, n, width, operations[:once], tables.flip_masks, tables, first, extra, 0, False)
    row = operations[once, TABLE]
    for b in range(1 << n):
        real, imaginary = x[here + b * width], x[here + ((1 << n) + b) * width]
        if row >= 0:
            u, v = tables.diagonals[row, 0, b], tables.diagonals[row, 1, b]
            real, imaginary = u * real - v * imaginary, u * imaginary + v * real
        psi[0, b], psi[1, b] = real, imaginary
    return psi


@jit
def prepare_backward(
    operations: Any, shape: Shape, taps: Any, factors: Any, tables: Tables, extra: Any, first: Any, adjoint: Any,
    sums_out: Any, stored: bool,
) -> None:  # fmt: skip
    """Adds the gradients of the angles before the first data to `sums_out` (taps,).

    `adjoint` (2, 2^n) is the adjoint of the state before the first data; it becomes that of the state `first`.
    """
    n, width = shape.n, shape.width
    count = len(taps)
    states = 1 + len(operations) if stored else 2
    x = np.zeros(layout(0, n, width, states, 0, 0, count, 0).end + 64, first.dtype)
    at = layout(start_of_line(x), n, width, states, 0, 0, count, 0)
    store(x, at.signs, splat(x.dtype.type(1)))
    store(x, at.signs + width, splat(x.dtype.type(-1)))
    here = _forward(x, at, n, width, operations, tables.flip_masks, tables, first, extra, 0, stored)
    for b in range(1 << n):
        x[at.adjoint + b * width], x[at.adjoint + ((1 << n) + b) * width] = adjoint[0, b], adjoint[1, b]
    _backward(
        x, at, n, width, operations, tables.flip_masks, tables.squares, taps, factors, tables, extra, here, stored
    )
    for k in range(count):
        sums_out[k] += x[at.sums + k * width]
    for b in range(1 << n):
        adjoint[0, b], adjoint[1, b] = x[at.adjoint + b * width], x[at.adjoint + ((1 << n) + b) * width]


@inner
def _read(x: Any, at: Layout, moving: Moving, block: int, n: int, width: int, extra: Any) -> None:
    """Copies a block's cosines and sines, and forms the phases of all basis states."""
    keep_apart()
    size = width << n
    trig, singles = moving
    # NumPy's layout becomes that of the passes, one number after the other; then whole vectors make the phases.
    count = trig.shape[2]
    for m in range(count):
        for part in range(2):
            for i in range(width):
                x[at.trig + (2 * m + part) * width + i] = trig[block, part, m, i]
    store(x, at.trig + 2 * count * width, splat(x.dtype.type(1)))
    store(x, at.trig + (2 * count + 1) * width, splat(x.dtype.type(0)))
    for row in range(len(singles)):
        forward_passes.input_phases(x, at.phases + row * size, n, width, at.trig, singles[row])
    if extra is not None:
        store(x, at.signs, splat(x.dtype.type(1)))
        store(x, at.signs + width, splat(x.dtype.type(-1)))
        for k in range(len(extra.products)):
            row, mask, m = extra.products[k]
            cosine = at.trig + 2 * m * width
            forward_passes.product_phases(x, at.phases + row * size, n, width, cosine, cosine + width, mask)


@jit
def forward(
    first: int, last: int, parts: int, operations: Any, once: int, shape: Shape, moving: Moving, start: Any,
    tables: Tables, measurement: Measurement, extra: Any, expectations: Any, out: Any,
) -> None:  # fmt: skip
    """The blocks of samples in the parts first..last.

    start (2, 2^n): the state that the first of the operations acts on; `once` of them are the same for all samples
    expectations (blocks, 2, n, width): <Z> and <X> before the last RY layer, if it is part of the measurement
    out (blocks, values, width)
    """
    measures_last_layer, masks, signs, last_layer = measurement
    n, width = shape.n, shape.width
    blocks, count, phases = out.shape[0], moving.trig.shape[2], len(moving.singles)
    x = np.empty(layout(0, n, width, 2, phases, count, 0, 0).end + 64, start.dtype)
    at = layout(start_of_line(x), n, width, 2, phases, count, 0, 0)
    q, d = at.scratch, at.gradients
    psi = _prepared(x, at, n, width, once, operations, tables, extra, start)
    operations, flips = operations[once:], tables.flip_masks[once:]
    # A block of samples at a time, through the whole circuit, while its state is in cache.
    for block in range(blocks * first // parts, blocks * last // parts):
        _read(x, at, moving, block, n, width, extra)
        end = _forward(x, at, n, width, operations, flips, tables, psi, extra, block, False)
        forward_passes.probabilities(x, end, n, width, q)
        if extra is not None:
            _measure_extra(x, at, end, n, width, len(masks), extra, block, out)
        # <Z> behind the last RY layer from <Z> and <X> before it: the layer itself need not be applied.
        if measures_last_layer:
            forward_passes.z_sums(x, q, n, width, d)
            forward_passes.x_expectations(x, end, n, width, d + n * width)
            for j in range(n):
                for i in range(width):
                    expectations[block, 0, j, i] = x[d + j * width + i]
                    expectations[block, 1, j, i] = x[d + (n + j) * width + i]
            for k in range(len(masks)):
                j = _wire(masks[k], n)
                for i in range(width):
                    z, x_ = expectations[block, 0, j, i], expectations[block, 1, j, i]
                    out[block, k, i] = last_layer[0, j] * z + last_layer[1, j] * x_
        # The expectation of every product of Z's from the probabilities; a few of them are asked for.
        elif len(masks):
            forward_passes.walsh(x, q, n, width)
            for k in range(len(masks)):
                for i in range(width):
                    out[block, k, i] = signs[k] * x[q + masks[k] * width + i]


@inner
def _wire(mask: int, n: int) -> int:
    """The wire of a single bit."""
    wire = n - 1
    while mask >> 1:
        mask, wire = mask >> 1, wire - 1
    return wire


@inner
def _measure_extra(
    x: Any, at: Layout, state: int, n: int, width: int, first: int, extra: Extra, block: int, out: Any
) -> None:
    """The words that are not of Z's alone, and the probabilities: values from `first` on."""
    keep_apart()
    words, outcomes, firsts = extra.words, extra.outcomes, extra.firsts
    for k in range(len(words)):
        word_passes.expectation(x, state, n, width, words[k], at.signs, at.gradients)
        for i in range(width):
            out[block, first + k, i] = x[at.gradients + i]
    first += len(words)
    for row in range(first, out.shape[1]):
        for i in range(width):
            out[block, row, i] = 0
    # Each basis state counts for one outcome of each table.
    for t in range(len(outcomes)):
        for b in range(1 << n):
            row = first + firsts[t] + outcomes[t, b]
            for i in range(width):
                out[block, row, i] += x[at.scratch + b * width + i]


@inner
def _apply_extra(x: Any, at: Layout, state: int, n: int, width: int, first: int, extra: Extra, gradient: Any) -> None:
    """Adds gradient_k O_k state to the adjoint, for the values of `_measure_extra`."""
    keep_apart()
    words, outcomes, firsts = extra.words, extra.outcomes, extra.firsts
    size, weights = width << n, at.signs + 2 * width
    for k in range(len(words)):
        for i in range(width):
            x[weights + i] = gradient[first + k, i]
        word_passes.store_signs(x, weights, width, load(x, weights))
        word_passes.add_word(x, state, at.adjoint, n, width, words[k], weights)
    first += len(words)
    # The operator of a probability projects on the basis states of an outcome.
    for t in range(len(outcomes)):
        for b in range(1 << n):
            row = first + firsts[t] + outcomes[t, b]
            for i in range(width):
                g, j = gradient[row, i], b * width + i
                x[at.adjoint + j] += g * x[state + j]
                x[at.adjoint + size + j] += g * x[state + size + j]


@jit
def backward(
    first: int, last: int, parts: int, operations: Any, once: int, shape: Shape, moving: Moving, start: Any,
    tables: Tables, measurement: Measurement, extra: Any, expectations: Any, last_taps: Any, taps: Any, factors: Any,
    gradient: Any, stored: bool, inputs_out: Any, sums_out: Any, adjoint_out: Any, starts_out: Any,
) -> None:  # fmt: skip
    """Gradients, given the gradients of the values: `gradient` (blocks, values, width). The rest is as in `forward`.

    last_taps (n,): the tap of each wire in the last RY layer, if it is part of the measurement; -1 for none
    inputs_out (blocks, K, width): of the inputs
    sums_out (parts, taps): of the angles, summed over each part
    adjoint_out (parts, 2, 2^n): of the state before the first data, summed over each part
    starts_out (blocks, 2, 2^n, width): of the starts, if each sample has its own
    """
    measures_last_layer, masks, signs, last_layer = measurement
    n, width, states, columns = shape
    blocks, count, phases = gradient.shape[0], moving.trig.shape[2], len(moving.singles)
    size = width << n
    x = np.zeros(layout(0, n, width, states, phases, count, len(taps), columns).end + 64, start.dtype)
    at = layout(start_of_line(x), n, width, states, phases, count, len(taps), columns)
    adjoint = at.adjoint
    psi = _prepared(x, at, n, width, once, operations, tables, extra, start)
    operations, flips, squares = operations[once:], tables.flip_masks[once:], tables.squares[once:]
    # A part is a fixed range of blocks with sums of its own, whichever thread takes it. The sums over all parts are
    # taken in order afterwards, so the bits do not depend on the number of threads.
    for part in range(first, last):
        fill_zero(x, at.sums, len(taps), width)
        fill_zero(x, at.first_adjoint, 2 << n, width)
        for block in range(blocks * part // parts, blocks * (part + 1) // parts):
            _read(x, at, moving, block, n, width, extra)
            end = _forward(x, at, n, width, operations, flips, tables, psi, extra, block, stored)
            # The adjoint starts as sum_k g_k O_k |state>. Where the last RY layer is part of the measurement, O_k is
            # a Z + b X of the output's wire, and the angles of that layer have their gradients from <Z> and <X>.
            if measures_last_layer:
                fill_zero(x, at.factors, 2 * n, width)
                for k in range(len(masks)):
                    j = _wire(masks[k], n)
                    a, b = at.factors + j * width, at.factors + (n + j) * width
                    for i in range(width):
                        g, z, x_ = gradient[block, k, i], expectations[block, 0, j, i], expectations[block, 1, j, i]
                        x[a + i] += last_layer[0, j] * g
                        x[b + i] += last_layer[1, j] * g
                        if last_taps[j] >= 0:
                            x[at.sums + last_taps[j] * width + i] += g * (last_layer[2, j] * z + last_layer[3, j] * x_)
                backward_passes.apply_observables(x, end, adjoint, n, width, at.factors, at.scratch)
            else:
                # The same transform takes the gradients of the words to the eigenvalues of sum_k g_k O_k.
                fill_zero(x, at.scratch, 1 << n, width)
                for k in range(len(masks)):
                    for i in range(width):
                        x[at.scratch + masks[k] * width + i] = signs[k] * gradient[block, k, i]
                if len(masks):
                    forward_passes.walsh(x, at.scratch, n, width)
                for i in range(0, size, width):
                    value = load(x, at.scratch + i)
                    store(x, adjoint + i, value * load(x, end + i))
                    store(x, adjoint + size + i, value * load(x, end + size + i))
                if extra is not None:
                    _apply_extra(x, at, end, n, width, len(masks), extra, gradient[block])
            fill_zero(x, at.inputs, columns, width)
            _backward(x, at, n, width, operations, flips, squares, taps, factors, tables, extra, end, stored)
            for j in range(columns):
                for i in range(width):
                    inputs_out[block, j, i] = x[at.inputs + j * width + i]
            if extra is not None and len(extra.starts):
                for side in range(2):
                    for b in range(1 << n):
                        for i in range(width):
                            starts_out[block, side, b, i] = x[adjoint + ((side << n) + b) * width + i]
        # The lanes of each vector are samples; they are added up once a part.
        for k in range(len(taps)):
            sums_out[part, k] = lane_sum(x, at.sums + k * width, width)
        for b in range(1 << n):
            adjoint_out[part, 0, b] = lane_sum(x, at.first_adjoint + b * width, width)
            adjoint_out[part, 1, b] = lane_sum(x, at.first_adjoint + size + b * width, width)
