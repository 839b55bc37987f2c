"""The compiled state-vector engine: CPU, float32 and float64, with adjoint differentiation of its own.

Once a step, the weights become tables (`tables.bind_weights`), and the part of the circuit before the first encoding is
applied to one state. Then every block of samples goes through the rest of the circuit. The last RY layer is not
applied; it only rotates what is measured.

The backward pass runs each block again and stores the state before each RY layer (in cache, a few hundred KiB). Then it
carries the adjoint state sum_k g_k O_k |psi> back gate by gate, so that every gradient is one inner product of the two
states. Between forward and backward only <Z> and <X> are stored: memory does not depend on S.

Sums over samples are taken over a fixed number of parts in a fixed order, so results do not depend on the number of
threads.

Shapes: n wires; `width` samples in a block; `encodings` different scales of the input; `steps` of the normal form.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from qnerf.kernels.jit import jit, run
from qnerf.quantum import statevector
from qnerf.quantum.compiled import backward_passes, forward_passes
from qnerf.quantum.compiled.simd import inner, keep_apart, lanes, load, splat, start_of_line, store
from qnerf.quantum.compiled.tables import (
    DIAGONAL,
    PERMUTATION,
    RY,
    RY_PER_SAMPLE,
    START,
    CircuitArrays,
    add_weight_gradients,
    bind_weights,
    circuit_arrays,
)
from qnerf.quantum.normal_form import NormalForm

PARTS = 32  # sums of gradients over a batch


class Layout(NamedTuple):
    """Where the parts of a thread's flat work array begin. A state takes 2 width 2^n elements."""

    state: int  # one state, or all that the backward pass stores
    adjoint: int  # the adjoint state, and a spare one
    scratch: int  # 2^n + 1 vectors
    first_adjoint: int  # the adjoint of the state that all samples start from
    phases: int  # encodings x 2^n vectors: the input's phases of the basis states
    trig: int  # encodings x 2 n vectors: cos and sin of half the encoding angles
    half_angles: int  # 2 n vectors: cos and sin of half an RY_PER_SAMPLE's angles
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
    half_angles = trig + 2 * encodings * n * width
    sums = half_angles + 2 * n * width
    inputs = sums + steps * n * width
    gradients = inputs + n * width
    factors = gradients + 2 * n * width
    end = factors + 2 * n * width
    return Layout(
        start, adjoint, scratch, first_adjoint, phases, trig, half_angles, sums, inputs, gradients, factors, end
    )


@inner
def _size(n: int, width: int, states: int, encodings: int, steps: int) -> int:
    """Elements of the work array; 64 more than the layout, because it starts at a cache line."""
    return _layout(0, n, width, states, encodings, steps).end + 64


@inner
def _add_angles(x: Any, at: Layout, n: int, width: int, encoding: int, fixed: Any, signs: Any) -> None:
    """`half_angles` = cos and sin of half of (the input's angle + the fixed angle)."""
    keep_apart()
    trig, out = at.trig + 2 * encoding * n * width, at.half_angles
    for j in range(n):
        c, s = load(x, trig + j * width), splat(signs[j]) * load(x, trig + (n + j) * width)
        u, v = splat(fixed[0, j]), splat(fixed[1, j])
        store(x, out + j * width, u * c - v * s)
        store(x, out + (n + j) * width, u * s + v * c)


@inner
def _forward(x: Any, at: Layout, n: int, width: int, operations: Any, tables: Any, psi: Any, store_states: bool) -> int:
    """Runs the operations and returns where the final state lies.

    With `store_states` the state before each operation that is no diagonal stays in the work array.
    """
    keep_apart()
    diagonals, tangents, flip_masks, angle_signs, permutations = tables
    pair = 2 * (width << n)
    here = at.state
    for o in range(len(operations)):
        code, step, encoding = operations[o, 0], operations[o, 1], operations[o, 2]
        p = -1 if encoding < 0 else at.phases + encoding * (pair >> 1)
        after = here + pair if store_states else here
        if code == START:
            forward_passes.start(x, here, n, width, psi, p, flip_masks[step] if step >= 0 else 0)
        elif code == DIAGONAL:
            forward_passes.diagonal(x, here, n, width, diagonals[step], p, flip_masks[step])
        elif code == RY:
            forward_passes.ry_layer(x, here, after, n, width, tangents[step, 0], True)
            here = after
        elif code == RY_PER_SAMPLE:
            _add_angles(x, at, n, width, encoding, tangents[step], angle_signs[step])
            forward_passes.ry_layer_per_sample(x, here, after, n, width, at.half_angles, True)
            here = after
        else:
            if not store_states:
                after = at.state + pair if here == at.state else at.state
            forward_passes.permute(x, here, after, n, width, permutations[operations[o, 3]], True)
            here = after
    return here


@inner
def _backward(
    x: Any, at: Layout, n: int, width: int, operations: Any, tables: Any, input_scales: Any, here: int
) -> None:
    """Carries the adjoint state back through the operations; `here` is the last of the stored states.

    Adds to the work array's `sums`, `first_adjoint` and `inputs`.
    """
    keep_apart()
    diagonals, tangents, flip_masks, angle_signs, permutations = tables
    pair = 2 * (width << n)
    adjoint, scratch, d = at.adjoint, at.scratch, at.gradients
    for o in range(len(operations) - 1, -1, -1):
        code, step, encoding = operations[o, 0], operations[o, 1], operations[o, 2]
        p = -1 if encoding < 0 else at.phases + encoding * (pair >> 1)
        if code == RY:
            forward_passes.ry_layer(x, adjoint, adjoint, n, width, tangents[step, 0], False)
            here -= pair
            backward_passes.ry_gradients(x, here, adjoint, n, width, d)
        elif code == RY_PER_SAMPLE:
            _add_angles(x, at, n, width, encoding, tangents[step], angle_signs[step])
            forward_passes.ry_layer_per_sample(x, adjoint, adjoint, n, width, at.half_angles, False)
            here -= pair
            backward_passes.ry_gradients(x, here, adjoint, n, width, d)
        elif code == PERMUTATION:
            here -= pair
            forward_passes.permute(x, adjoint, adjoint + pair, n, width, permutations[operations[o, 3]], False)
            for i in range(0, pair, width):
                store(x, adjoint + i, load(x, adjoint + pair + i))
        elif code == DIAGONAL:
            backward_passes.diagonal_backward(
                x, here, adjoint, n, width, diagonals[step], p, flip_masks[step], scratch, d
            )
        else:
            mask = flip_masks[step] if step >= 0 else 0
            backward_passes.start_backward(x, here, adjoint, n, width, p, mask, scratch, d, at.first_adjoint)
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


@jit
def prepare(operations: Any, n: int, width: int, amplitude: float, like: Any, tables: Any, psi: Any) -> None:
    """Fills psi (2, 2^n), real and imaginary parts: the state before the first encoding."""
    x = np.empty(_size(n, width, 2, 0, 0), like.dtype)
    at = _layout(start_of_line(x), n, width, 2, 0, 0)
    size = width << n
    zero = np.zeros((2, 1 << n), like.dtype)
    zero[0, 0] = amplitude
    end = _forward(x, at, n, width, operations, tables, zero, False)
    for b in range(1 << n):
        psi[0, b] = x[end + b * width]
        psi[1, b] = x[end + size + b * width]


@jit
def prepare_backward(
    operations: Any, n: int, width: int, amplitude: float, like: Any, tables: Any, adjoint: Any, input_scales: Any,
    sums_out: Any,
) -> None:  # fmt: skip
    """Adds the gradients of the angles before the first encoding to `sums_out` (steps, n).

    `adjoint` (2, 2^n) is the adjoint of the state psi that `prepare` makes.
    """
    steps, states = len(sums_out), 1 + len(operations)
    x = np.zeros(_size(n, width, states, 0, steps), like.dtype)
    at = _layout(start_of_line(x), n, width, states, 0, steps)
    size = width << n
    zero = np.zeros((2, 1 << n), like.dtype)
    zero[0, 0] = amplitude
    end = _forward(x, at, n, width, operations, tables, zero, True)
    for b in range(1 << n):
        x[at.adjoint + b * width] = adjoint[0, b]
        x[at.adjoint + size + b * width] = adjoint[1, b]
    _backward(x, at, n, width, operations, tables, input_scales, end)
    for step in range(steps):
        for j in range(n):
            sums_out[step, j] += x[at.sums + (step * n + j) * width]


@inner
def _read(x: Any, at: Layout, trig: Any, n: int, width: int) -> None:
    """Copies a block's cosines and sines, and forms the phases of all basis states."""
    keep_apart()
    size = width << n
    for encoding in range(trig.shape[0]):
        here = at.trig + 2 * encoding * n * width
        for part in range(2):
            for j in range(n):
                for i in range(width):
                    x[here + (part * n + j) * width + i] = trig[encoding, part, j, i]
        forward_passes.input_phases(x, at.phases + encoding * size, n, width, here)


@jit
def forward(
    first: int, last: int, parts: int, operations: Any, n: int, width: int, trig: Any, psi: Any, tables: Any,
    measurement: Any, expectations: Any, out: Any,
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
    for block in range(blocks * first // parts, blocks * last // parts):
        _read(x, at, trig[block], n, width)
        end = _forward(x, at, n, width, operations, tables, psi, False)
        forward_passes.probabilities(x, end, n, width, q)
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
    first: int, last: int, parts: int, operations: Any, n: int, width: int, trig: Any, psi: Any, tables: Any,
    measurement: Any, expectations: Any, states: int, input_scales: Any, gradient: Any, inputs_out: Any, sums_out: Any,
    adjoint_out: Any,
) -> None:  # fmt: skip
    """Gradients from those of the outputs, `gradient` (blocks, outputs, width); the others as in `forward`.

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
    for part in range(first, last):
        _fill_zero(x, at.sums, steps * n, width)
        _fill_zero(x, at.first_adjoint, 2 << n, width)
        for block in range(blocks * part // parts, blocks * (part + 1) // parts):
            _read(x, at, trig[block], n, width)
            end = _forward(x, at, n, width, operations, tables, psi, True)
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
        for step in range(steps):
            for j in range(n):
                sums_out[part, step, j] = _sum(x, at.sums + (step * n + j) * width, width)
        for b in range(1 << n):
            adjoint_out[part, 0, b] = _sum(x, at.first_adjoint + b * width, width)
            adjoint_out[part, 1, b] = _sum(x, at.first_adjoint + size + b * width, width)


class StatevectorEngine:
    """A circuit ready to run, without its weights."""

    def __init__(self, form: NormalForm) -> None:
        self.form = form
        self.arrays: CircuitArrays = circuit_arrays(form)

    def bind(self, weights: np.ndarray, dtype: Any) -> "BoundEngine":
        """The engine with these weights, (rows * 3, n) float64 in radians, in the given precision."""
        return BoundEngine(self.arrays, weights, dtype)


class BoundEngine:
    """An engine with its weights: valid for one step. It takes NumPy arrays in blocks of `lanes` samples."""

    def __init__(self, arrays: CircuitArrays, weights: np.ndarray, dtype: Any) -> None:
        self.arrays, self.dtype = arrays, np.dtype(dtype)
        steps, n = arrays.constants.shape
        self.n, self.width = n, lanes(self.dtype.itemsize)
        tangents, diagonals = np.zeros((steps, 2, n)), np.zeros((steps, 2, 2**n))
        flip_masks, self.angle_signs = np.zeros(steps, dtype=np.int64), np.zeros((steps, n))
        last_layer, eigenvalues = np.zeros((4, n)), np.empty(arrays.eigenvalues.shape)
        self.amplitude = bind_weights(
            arrays.codes, arrays.weight_ranges, arrays.weight_rows, arrays.constants, arrays.cz_signs, arrays.cnots,
            arrays.eigenvalues, arrays.form.measures_last_layer, weights, tangents, diagonals, flip_masks,
            self.angle_signs, last_layer, eigenvalues,
        )  # fmt: skip
        cast = [array.astype(self.dtype) for array in (diagonals, tangents, self.angle_signs)]
        self.tables = cast[0], cast[1], flip_masks, cast[2], arrays.permutations
        measures_last_layer = arrays.form.measures_last_layer
        self.measurement = (
            measures_last_layer, arrays.wires, eigenvalues.astype(self.dtype), last_layer.astype(self.dtype)
        )  # fmt: skip
        self.psi = np.empty((2, 2**n), self.dtype)
        prepare(arrays.once, n, self.width, self.amplitude, self.psi, self.tables, self.psi)
        code, step, _, _ = arrays.per_sample[0]
        # The fixed phases of a first encoding that is diagonal belong to the state that all samples start from.
        self.first_diagonal = cast[0][step] if code == START and step >= 0 else None
        self.start = self.psi
        if self.first_diagonal is not None:
            u, v = self.first_diagonal
            self.start = np.stack([u * self.psi[0] - v * self.psi[1], u * self.psi[1] + v * self.psi[0]])

    def _shared(self, trig: np.ndarray) -> tuple[Any, ...]:
        """Arguments that `forward` and `backward` begin with."""
        parts = parts_of(trig)
        return parts, parts, self.arrays.per_sample, self.n, self.width, trig, self.start, self.tables, self.measurement

    def forward(self, trig: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """trig (blocks, encodings, 2, n, width) -> outputs (blocks, outputs, width), and what `backward` needs.

        `trig` holds cos and sin of half the encoding angles, see `cos_sin_of_half`.
        """
        blocks = trig.shape[0] if self.arrays.form.measures_last_layer else 0
        expectations = np.empty((blocks, 2, self.n, self.width), self.dtype)
        out = np.empty((trig.shape[0], len(self.arrays.wires), self.width), self.dtype)
        run(forward, *self._shared(trig), expectations, out)
        return out, expectations

    def backward(
        self, trig: np.ndarray, expectations: np.ndarray, gradient: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Gradients of the inputs (blocks, n, width) and of the weights (rows * 3, n)."""
        arrays, n = self.arrays, self.n
        blocks, parts = trig.shape[0], parts_of(trig)
        inputs = np.empty((blocks, n, self.width), self.dtype)
        sums, adjoints = np.zeros((parts, len(arrays.codes), n)), np.zeros((parts, 2, 2**n))
        run(
            backward, *self._shared(trig), expectations, arrays.stored_states, arrays.input_scales, gradient, inputs,
            sums, adjoints,
        )  # fmt: skip
        total, adjoint = sums.sum(0), adjoints.sum(0)
        if self.first_diagonal is not None:
            u, v = self.first_diagonal.astype(np.float64)
            adjoint = np.stack([u * adjoint[0] + v * adjoint[1], u * adjoint[1] - v * adjoint[0]])
        prepare_backward(
            arrays.once, n, self.width, self.amplitude, self.psi, self.tables, adjoint, arrays.input_scales, total
        )
        weights = np.zeros((arrays.form.circuit.rows * 3, n))
        add_weight_gradients(arrays.weight_ranges, arrays.weight_rows, self.angle_signs, total, weights)
        return inputs, weights


# The functions below take NumPy arrays rather than tensors. The arrays are small, and torch would wake its OpenMP
# threads for them, which on a busy machine takes far longer than the work.
def parts_of(trig: np.ndarray) -> int:
    """Into how many parts sums over these blocks (blocks, ...) are split, whatever the number of threads."""
    return min(PARTS, max(trig.shape[0], 1))


def to_blocks(x: np.ndarray, width: int) -> np.ndarray:
    """(B, n) -> (blocks, n, width), padded with zeros."""
    batch, n = x.shape
    blocks = -(-batch // width)
    if blocks * width != batch:
        x = np.concatenate([x, np.zeros((blocks * width - batch, n), x.dtype)])
    return np.ascontiguousarray(x.reshape(blocks, width, n).transpose(0, 2, 1))


def from_blocks(x: np.ndarray, batch: int) -> Tensor:
    """(blocks, n, width) -> (B, n)."""
    flat = np.ascontiguousarray(x.transpose(0, 2, 1)).reshape(-1, x.shape[1])
    return torch.from_numpy(flat[:batch])


def cos_sin(x: np.ndarray, factors: np.ndarray, out: np.ndarray) -> None:
    """out[0], out[1] = cos, sin of the inputs (blocks, n, width) times a factor (n,) for each wire; infinity gives NaN.

    As in `statevector.cos_sin`, a product that the inputs' dtype would round is taken in float64.
    """
    mantissas = np.abs(np.frexp(factors)[0])
    exact = bool(((mantissas == 0.5) | (mantissas == 0)).all())
    angles = factors[:, None].astype(x.dtype if exact else np.float64) * x
    with np.errstate(invalid="ignore"):
        np.cos(angles, out=out[0], casting="same_kind")
        np.sin(angles, out=out[1], casting="same_kind")


def cos_sin_of_half(x: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """cos and sin of half the scaled inputs: (blocks, n, width) -> (blocks, encodings, 2, n, width)."""
    out = np.empty((x.shape[0], len(scales), 2, *x.shape[1:]), x.dtype)
    for encoding, scale in enumerate(scales):
        cos_sin(x, 0.5 * scale, out[:, encoding].swapaxes(0, 1))
    return out


class _Simulate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, engine: StatevectorEngine, x: Tensor, weights: Tensor) -> Tensor:
        bound = engine.bind(flat_weights(weights), numpy_dtype(x.dtype))
        trig = cos_sin_of_half(to_blocks(x.detach().numpy(), bound.width), engine.arrays.encoding_scales)
        out, expectations = bound.forward(trig)
        ctx.save_for_backward(x, weights)
        ctx.form = engine.form
        ctx.saved = bound, trig, expectations
        ctx.shapes = x.shape[0], weights.shape, weights.dtype
        return from_blocks(out, x.shape[0]).clamp_(-1, 1)  # rounding may lead beyond

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            return None, *differentiable_gradients(ctx, partial(statevector.evaluate, ctx.form), gradient)
        bound, trig, expectations = ctx.saved
        batch, shape, dtype = ctx.shapes
        inputs, weights = bound.backward(trig, expectations, to_blocks(gradient.detach().numpy(), bound.width))
        return None, from_blocks(inputs, batch), torch.from_numpy(weights).to(dtype).reshape(shape)


def differentiable_gradients(
    ctx: Any, evaluate: Callable[[Tensor, Tensor], Tensor], gradient: Tensor
) -> list[Tensor | None]:
    """The gradients of inputs and weights through plain PyTorch, for `create_graph=True`: they have derivatives again.

    The compiled backward pass is a constant to autograd, so second derivatives through it would be wrong.
    """
    inputs = ctx.saved_tensors
    needed = [tensor for tensor in inputs if tensor.requires_grad]
    gradients = iter(torch.autograd.grad(evaluate(*inputs), needed, gradient, create_graph=True))
    return [next(gradients) if tensor.requires_grad else None for tensor in inputs]


def numpy_dtype(dtype: torch.dtype) -> Any:
    return np.float32 if dtype == torch.float32 else np.float64


def flat_weights(weights: Tensor) -> np.ndarray:
    """Stacked weights (rows, 3, n) -> (rows * 3, n) float64."""
    return weights.detach().double().reshape(-1, weights.shape[-1]).contiguous().numpy()


def evaluate(engine: StatevectorEngine, x: Tensor, weights: Tensor) -> Tensor:
    """Expectation values (B, outputs) for inputs x (B, n) in radians and stacked weights (rows, 3, n), on the CPU."""
    return _Simulate.apply(engine, x, weights)
