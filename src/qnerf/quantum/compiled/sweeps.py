"""Compiled sweeps over the samples of a step: one through the circuit, one back; `engine` gives them their arrays.

The forward sweep takes each block of samples through the circuit. The backward sweep runs each block again and stores
the state before each RY layer (in cache, a few hundred KiB). Then it carries the adjoint state sum_k g_k O_k |psi> back
gate by gate, so that every gradient is one inner product of the two states.

Shapes: n wires; `width` samples in a block; `encodings` different scales of the input; `steps` of the normal form.
"""

from typing import Any, NamedTuple

import numpy as np

from qnerf.kernels.jit import jit
from qnerf.kernels.simd import inner, keep_apart, load, splat, start_of_line, store
from qnerf.quantum.compiled import backward_passes, forward_passes
from qnerf.quantum.compiled.tables import (
    DIAGONAL,
    PERMUTATION,
    RY,
    START,
    Measurement,
    Tables,
)

# Numba compiles a function once more for every True and False of Python's that it is called with.
FORWARD = STORED = np.bool_(True)
BACK = NOT_STORED = np.bool_(False)


class Layout(NamedTuple):
    """Where the parts of a thread's flat work array begin. A state takes 2 width 2^n elements."""

    state: int  # one state, or all that the backward pass stores
    adjoint: int  # the adjoint state, and a spare one
    scratch: int  # 2^n + 1 vectors
    first_adjoint: int  # the adjoint of the state that all samples start from
    phases: int  # encodings x 2^n vectors: the input's phases of the basis states
    trig: int  # encodings x 2 n vectors: cos and sin of half the encoding angles
    sums: int  # steps x n vectors: gradients of the angles, summed over blocks
    inputs: int  # n vectors: gradients of the inputs
    gradients: int  # 2 n vectors: of the step at hand
    factors: int  # 2 n vectors: of Z and X in the observable
    end: int


@inner
def _layout(start: int, n: int, width: int, states: int, encodings: int, steps: int) -> Layout:
    size = width << n
    adjoint = start + 2 * states * size
    scratch = adjoint + 4 * size
    first_adjoint = scratch + size + width
    phases = first_adjoint + 2 * size
    trig = phases + encodings * size
    sums = trig + 2 * encodings * n * width
    inputs = sums + steps * n * width
    gradients = inputs + n * width
    factors = gradients + 2 * n * width
    end = factors + 2 * n * width
    return Layout(start, adjoint, scratch, first_adjoint, phases, trig, sums, inputs, gradients, factors, end)


@inner
def _size(n: int, width: int, states: int, encodings: int, steps: int) -> int:
    """Elements of the work array; 64 more than the layout, because it starts at a cache line."""
    return _layout(0, n, width, states, encodings, steps).end + 64


@jit
def _forward(
    x: Any, at: Layout, n: int, width: int, operations: Any, tables: Tables, psi: Any, store_states: bool
) -> int:
    """Runs the operations and returns where the final state lies.

    With `store_states` the state before each operation but diagonals stays in the work array.
    """
    keep_apart()
    tangents, diagonals, flip_masks, _, permutations = tables
    pair = 2 * (width << n)
    here = at.state
    # Diagonals work in place. With `store_states` every other operation writes the state behind the one that it reads,
    # so that the states stay in the work array in order.
    for o in range(len(operations)):
        code, step, encoding = operations[o, 0], operations[o, 1], operations[o, 2]
        p = -1 if encoding < 0 else at.phases + encoding * (pair >> 1)
        after = here + pair if store_states else here
        if code == START:
            forward_passes.start(x, here, n, width, psi, p, flip_masks[step] if step >= 0 else 0)
        elif code == DIAGONAL:
            forward_passes.diagonal(x, here, n, width, diagonals[step], p, flip_masks[step])
        elif code == RY:
            forward_passes.ry_layer(x, here, after, n, width, tangents[step], FORWARD)
            here = after
        else:
            # A permutation cannot work in place: two states take turns.
            if not store_states:
                after = at.state + pair if here == at.state else at.state
            forward_passes.permute(x, here, after, n, width, permutations[operations[o, 3]], FORWARD)
            here = after
    return here


@jit
def _backward(
    x: Any, at: Layout, n: int, width: int, operations: Any, tables: Tables, input_scales: Any, here: int
) -> None:
    """Carries the adjoint state back through the operations; `here` is the last of the stored states.

    Adds to the work array's `sums`, `first_adjoint` and `inputs`.
    """
    keep_apart()
    tangents, diagonals, flip_masks, angle_signs, permutations = tables
    pair = 2 * (width << n)
    adjoint, scratch, d = at.adjoint, at.scratch, at.gradients
    # Each operation is taken off the adjoint, and its gradients (a vector for each wire, at `d`) are inner products of
    # the adjoint with the state. Rotations use the state before them, which was stored; diagonals the one after them.
    for o in range(len(operations) - 1, -1, -1):
        code, step, encoding = operations[o, 0], operations[o, 1], operations[o, 2]
        p = -1 if encoding < 0 else at.phases + encoding * (pair >> 1)
        if code == RY:
            forward_passes.ry_layer(x, adjoint, adjoint, n, width, tangents[step], BACK)
            here -= pair
            backward_passes.ry_gradients(x, here, adjoint, n, width, d)
        elif code == PERMUTATION:
            here -= pair
            forward_passes.permute(x, adjoint, adjoint + pair, n, width, permutations[operations[o, 3]], BACK)
            for i in range(0, pair, width):
                store(x, adjoint + i, load(x, adjoint + pair + i))
        elif code == DIAGONAL:
            backward_passes.diagonal_backward(
                x, here, adjoint, n, width, diagonals[step], p, flip_masks[step], scratch, d
            )
        else:
            mask = flip_masks[step] if step >= 0 else 0
            backward_passes.start_backward(x, here, adjoint, n, width, p, mask, scratch, d, at.first_adjoint)
        # The gradients are added to the sums of the step, and to the gradient of the input where the angles hold it.
        if step >= 0 and code != PERMUTATION:
            for j in range(n):
                value = load(x, d + j * width)
                total = at.sums + (step * n + j) * width
                store(x, total, load(x, total) + value)
                if encoding >= 0:
                    scale = splat(x.dtype.type(input_scales[step, j] * angle_signs[step, j]))
                    store(x, at.inputs + j * width, load(x, at.inputs + j * width) + scale * value)


@inner
def _fill_zero(x: Any, first: int, vectors: int, width: int) -> None:
    for i in range(first, first + vectors * width, width):
        store(x, i, splat(x.dtype.type(0)))


@inner
def _sum(x: Any, first: int, width: int) -> float:
    keep_apart()
    value = 0.0
    for i in range(first, first + width):
        value += x[i]
    return value


def prepare(operations: np.ndarray, n: int, width: int, amplitude: float, tables: Tables, psi: np.ndarray) -> None:
    """Fills psi (2, 2^n), real and imaginary parts: the state before the first encoding."""
    x, at = _work_array(n, width, 2, 0, psi.dtype)
    end = _forward(x, at, n, width, operations, tables, _ground_state(n, amplitude, psi.dtype), NOT_STORED)
    psi[:] = _state(x, end, n, width)[..., 0]


def prepare_backward(
    operations: np.ndarray, n: int, width: int, amplitude: float, tables: Tables, adjoint: np.ndarray,
    input_scales: np.ndarray, sums_out: np.ndarray, dtype: Any,
) -> None:  # fmt: skip
    """Adds the gradients of the angles before the first encoding to `sums_out` (steps, n).

    `adjoint` (2, 2^n) is the adjoint of the state psi that `prepare` makes.
    """
    steps = len(sums_out)
    x, at = _work_array(n, width, 1 + len(operations), steps, dtype)
    end = _forward(x, at, n, width, operations, tables, _ground_state(n, amplitude, dtype), STORED)
    _state(x, at.adjoint, n, width)[..., 0] = adjoint
    _backward(x, at, n, width, operations, tables, input_scales, end)
    sums_out += x[at.sums : at.sums + steps * n * width].reshape(steps, n, width)[..., 0]


def _work_array(n: int, width: int, states: int, steps: int, dtype: Any) -> tuple[np.ndarray, Layout]:
    """A work array for the steps before the first encoding, filled with zeros."""
    layout: Any = _layout
    x = np.zeros(layout.py_func(0, n, width, states, 0, steps).end + 64, dtype)
    return x, layout.py_func(-x.ctypes.data % 64 // x.itemsize, n, width, states, 0, steps)


def _ground_state(n: int, amplitude: float, dtype: Any) -> np.ndarray:
    psi = np.zeros((2, 1 << n), dtype)
    psi[0, 0] = amplitude
    return psi


def _state(x: np.ndarray, first: int, n: int, width: int) -> np.ndarray:
    """The state (2, 2^n, width) that begins at x[first]."""
    return x[first : first + 2 * (width << n)].reshape(2, 1 << n, width)


@inner
def _read(x: Any, at: Layout, trig: Any, n: int, width: int) -> None:
    """Copies a block's cosines and sines, and forms the phases of all basis states."""
    keep_apart()
    size = width << n
    # NumPy's layout becomes that of the passes, one number after the other; then whole vectors make the phases.
    for encoding in range(trig.shape[0]):
        here = at.trig + 2 * encoding * n * width
        for part in range(2):
            for j in range(n):
                for i in range(width):
                    x[here + (part * n + j) * width + i] = trig[encoding, part, j, i]
        forward_passes.input_phases(x, at.phases + encoding * size, n, width, here)


@jit
def forward(
    first: int, last: int, parts: int, operations: Any, n: int, width: int, trig: Any, psi: Any, tables: Tables,
    measurement: Measurement, expectations: Any, out: Any,
) -> None:  # fmt: skip
    """The blocks of samples in the parts first..last.

    trig (blocks, encodings, 2, n, width): cos and sin of half the encoding angles
    expectations (blocks, 2, n, width): <Z> and <X> before the last RY layer, if it is part of the measurement
    out (blocks, outputs, width)
    """
    measures_last_layer, wires, eigenvalues, last_layer = measurement
    blocks, encodings = trig.shape[0], trig.shape[1]
    x = np.empty(_size(n, width, 2, encodings, 0), psi.dtype)
    at = _layout(start_of_line(x), n, width, 2, encodings, 0)
    q, d = at.scratch, at.gradients
    # A block of samples at a time, through the whole circuit, while its state is in cache.
    for block in range(blocks * first // parts, blocks * last // parts):
        _read(x, at, trig[block], n, width)
        end = _forward(x, at, n, width, operations, tables, psi, NOT_STORED)
        forward_passes.probabilities(x, end, n, width, q)
        # <Z> behind the last RY layer from <Z> and <X> before it: the layer itself need not be applied.
        if measures_last_layer:
            forward_passes.z_sums(x, q, n, width, d)
            forward_passes.x_expectations(x, end, n, width, d + n * width)
            for j in range(n):
                for i in range(width):
                    expectations[block, 0, j, i] = x[d + j * width + i]
                    expectations[block, 1, j, i] = x[d + (n + j) * width + i]
            for k in range(len(wires)):
                j = wires[k]
                for i in range(width):
                    z, x_ = expectations[block, 0, j, i], expectations[block, 1, j, i]
                    out[block, k, i] = last_layer[0, j] * z + last_layer[1, j] * x_
        # Products of several Z's: the probabilities, each times its eigenvalue.
        else:
            for k in range(len(wires)):
                value = splat(psi.dtype.type(0))
                for b in range(1 << n):
                    value = value + splat(eigenvalues[k, b]) * load(x, q + b * width)
                store(x, d, value)
                for i in range(width):
                    out[block, k, i] = x[d + i]


@jit
def backward(
    first: int, last: int, parts: int, operations: Any, n: int, width: int, trig: Any, psi: Any, tables: Tables,
    measurement: Measurement, expectations: Any, states: int, input_scales: Any, gradient: Any, inputs_out: Any,
    sums_out: Any, adjoint_out: Any,
) -> None:  # fmt: skip
    """Gradients, given the gradients of the outputs: `gradient` (blocks, outputs, width). The rest is as in `forward`.

    inputs_out (blocks, n, width): of the inputs
    sums_out (parts, steps, n): of the angles, summed over each part
    adjoint_out (parts, 2, 2^n): of psi, summed over each part
    """
    measures_last_layer, wires, eigenvalues, last_layer = measurement
    blocks, encodings, steps = trig.shape[0], trig.shape[1], sums_out.shape[1]
    size = width << n
    x = np.zeros(_size(n, width, states, encodings, steps), psi.dtype)
    at = _layout(start_of_line(x), n, width, states, encodings, steps)
    adjoint, d = at.adjoint, at.gradients
    # A part is a fixed range of blocks with sums of its own, whichever thread takes it. The sums over all parts are
    # taken in order afterwards, so the bits do not depend on the number of threads.
    for part in range(first, last):
        _fill_zero(x, at.sums, steps * n, width)
        _fill_zero(x, at.first_adjoint, 2 << n, width)
        for block in range(blocks * part // parts, blocks * (part + 1) // parts):
            _read(x, at, trig[block], n, width)
            end = _forward(x, at, n, width, operations, tables, psi, STORED)
            # The adjoint starts as sum_k g_k O_k |state>. Where the last RY layer is part of the measurement, O_k is
            # a Z + b X of the output's wire, and the angles of that layer have their gradients from <Z> and <X>.
            if measures_last_layer:
                _fill_zero(x, at.factors, 2 * n, width)
                for k in range(len(wires)):
                    j = wires[k]
                    a, b, c = (
                        at.factors + j * width,
                        at.factors + (n + j) * width,
                        at.sums + ((steps - 1) * n + j) * width,
                    )
                    for i in range(width):
                        g, z, x_ = gradient[block, k, i], expectations[block, 0, j, i], expectations[block, 1, j, i]
                        x[a + i] += last_layer[0, j] * g
                        x[b + i] += last_layer[1, j] * g
                        x[c + i] += g * (last_layer[2, j] * z + last_layer[3, j] * x_)
                backward_passes.apply_observables(x, end, adjoint, n, width, at.factors, at.scratch)
            else:
                _fill_zero(x, adjoint, 2 << n, width)
                for k in range(len(wires)):
                    for i in range(width):
                        x[d + i] = gradient[block, k, i]
                    g_ = load(x, d)
                    for b in range(1 << n):
                        i = b * width
                        value = splat(eigenvalues[k, b]) * g_
                        store(x, adjoint + i, load(x, adjoint + i) + value * load(x, end + i))
                        i += size
                        store(x, adjoint + i, load(x, adjoint + i) + value * load(x, end + i))
            _fill_zero(x, at.inputs, n, width)
            _backward(x, at, n, width, operations, tables, input_scales, end)
            for j in range(n):
                for i in range(width):
                    inputs_out[block, j, i] = x[at.inputs + j * width + i]
        # The lanes of each vector are samples; they are added up once a part.
        for step in range(steps):
            for j in range(n):
                sums_out[part, step, j] = _sum(x, at.sums + (step * n + j) * width, width)
        for b in range(1 << n):
            adjoint_out[part, 0, b] = _sum(x, at.first_adjoint + b * width, width)
            adjoint_out[part, 1, b] = _sum(x, at.first_adjoint + size + b * width, width)
