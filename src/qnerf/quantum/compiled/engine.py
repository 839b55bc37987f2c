"""The compiled state-vector engine: CPU, float32 and float64, with adjoint differentiation of its own.

Once a step, the weights become tables (`tables.bind_weights`), and the part of the circuit before the first encoding is
applied to one state. Then every block of samples goes through the rest of the circuit (`sweeps`). The last RY layer is
not applied; it only rotates what is measured. Between forward and backward only <Z> and <X> are stored: memory does not
depend on S.

Sums over samples are taken over a fixed number of parts in a fixed order, so results do not depend on the number of
threads.
"""

from functools import partial
from math import frexp
from typing import Any

import numpy as np
import torch
from torch import Tensor

from qnerf.kernels.derivatives import is_differentiated, through_reference
from qnerf.kernels.jit import run
from qnerf.kernels.simd import lanes
from qnerf.quantum import statevector
from qnerf.quantum.circuit import Circuit
from qnerf.quantum.compiled.sweeps import backward, forward, prepare, prepare_backward
from qnerf.quantum.compiled.tables import (
    START,
    CircuitArrays,
    Measurement,
    Tables,
    add_weight_gradients,
    bind_weights,
    circuit_arrays,
)
from qnerf.quantum.normal_form import NormalForm

PARTS = 32  # sums of gradients over a batch


class StatevectorEngine:
    """A circuit ready to run, without its weights."""

    def __init__(self, form: NormalForm) -> None:
        self.form = form
        self.arrays: CircuitArrays = circuit_arrays(form)

    def bind(self, weights: np.ndarray, dtype: Any) -> "BoundEngine":
        """The engine with these weights, (rows, n, 3) float64 in radians, in the given precision."""
        return BoundEngine(self.arrays, weights, dtype)


class BoundEngine:
    """An engine with its weights: valid for one step. It takes NumPy arrays in blocks of `lanes` samples."""

    def __init__(self, arrays: CircuitArrays, weights: np.ndarray, dtype: Any) -> None:
        self.arrays, self.dtype = arrays, np.dtype(dtype)
        steps, n = arrays.steps.constants.shape
        self.n, self.width = n, lanes(self.dtype.itemsize)
        tables = Tables(
            np.zeros((steps, n)), np.zeros((steps, 2, 2**n)), np.zeros(steps, np.int64), np.zeros((steps, n)),
            arrays.permutations,
        )  # fmt: skip
        last_layer, flipped = np.zeros((4, n)), np.empty(arrays.eigenvalues.shape)
        measured = Measurement(arrays.form.measures_last_layer, arrays.wires, arrays.eigenvalues, last_layer)
        self.amplitude = bind_weights(arrays.steps, weights, measured, tables, flipped)
        self.measurement = measured._replace(
            eigenvalues=flipped.astype(self.dtype), last_layer=last_layer.astype(self.dtype)
        )
        self.tables = Tables(
            tables.tangents.astype(self.dtype), tables.diagonals.astype(self.dtype), tables.flip_masks,
            tables.angle_signs.astype(self.dtype), arrays.permutations,
        )  # fmt: skip
        self.psi = np.empty((2, 2**n), self.dtype)
        prepare(arrays.once, n, self.width, self.amplitude, self.tables, self.psi)
        code, step, _, _ = arrays.per_sample[0]
        # The fixed phases of a first encoding that is diagonal belong to the state that all samples start from.
        self.first_diagonal = self.tables.diagonals[step] if code == START and step >= 0 else None
        self.start = self.psi
        if self.first_diagonal is not None:
            u, v = self.first_diagonal
            self.start = np.empty_like(self.psi)
            self.start[0] = u * self.psi[0] - v * self.psi[1]
            self.start[1] = u * self.psi[1] + v * self.psi[0]

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
        """Gradients of the inputs (blocks, n, width) and of the weights (rows, n, 3)."""
        arrays, n = self.arrays, self.n
        blocks, parts = trig.shape[0], parts_of(trig)
        inputs = np.empty((blocks, n, self.width), self.dtype)
        sums, adjoints = np.zeros((parts, len(arrays.steps.codes), n)), np.zeros((parts, 2, 2**n))
        run(
            backward, *self._shared(trig), expectations, arrays.stored_states, arrays.input_scales, gradient, inputs,
            sums, adjoints,
        )  # fmt: skip
        total, adjoint = (sums[0], adjoints[0]) if parts == 1 else (sums.sum(0), adjoints.sum(0))
        if self.first_diagonal is not None:
            u, v = self.first_diagonal.astype(np.float64)
            adjoint = np.stack([u * adjoint[0] + v * adjoint[1], u * adjoint[1] - v * adjoint[0]])
        prepare_backward(
            arrays.once, n, self.width, self.amplitude, self.tables, adjoint, arrays.input_scales, total, self.dtype,
        )  # fmt: skip
        weights = np.zeros((arrays.form.circuit.rows, n, 3))
        add_weight_gradients(arrays.steps, self.tables.angle_signs, total, weights)
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
    flat = np.ascontiguousarray(x.transpose(0, 2, 1)).reshape(x.shape[0] * x.shape[2], x.shape[1])
    return torch.from_numpy(flat[:batch])


def cos_sin(x: np.ndarray, factors: np.ndarray, out: np.ndarray) -> None:
    """out[0], out[1] = cos, sin of the inputs (blocks, n, width) times a factor (n,) for each wire; infinity gives NaN.

    As in `statevector.cos_sin`, a product that the inputs' dtype would round is taken in float64.
    """
    exact = all(abs(frexp(factor)[0]) in (0, 0.5) for factor in factors.tolist())
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
        bound = engine.bind(by_row(weights, engine.form.circuit), numpy_dtype(x.dtype))
        trig = cos_sin_of_half(to_blocks(x.detach().numpy(), bound.width), engine.arrays.encoding_scales)
        out, expectations = bound.forward(trig)
        ctx.save_for_backward(x, weights)
        ctx.form = engine.form
        ctx.saved = bound, trig, expectations
        ctx.shapes = x.shape[0], weights.shape, weights.dtype
        # Rounding may lead beyond. PyTorch would share this with threads, which then spin beside the loops.
        return from_blocks(np.clip(out, -1, 1, out=out), x.shape[0])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        if is_differentiated(gradient):
            return None, *through_reference(partial(statevector.evaluate, ctx.form), ctx.saved_tensors, gradient)
        bound, trig, expectations = ctx.saved
        batch, shape, dtype = ctx.shapes
        inputs, weights = bound.backward(
            trig, expectations, to_blocks(gradient.detach().resolve_neg().numpy(), bound.width)
        )
        return None, from_blocks(inputs, batch), torch.from_numpy(weights).to(dtype).reshape(shape)


def numpy_dtype(dtype: torch.dtype) -> Any:
    return np.float32 if dtype == torch.float32 else np.float64


def by_row(weights: Tensor, circuit: Circuit) -> np.ndarray:
    """The weights of a re-uploading circuit as (rows, n, 3) float64."""
    return weights.detach().double().reshape(circuit.rows, circuit.wires, 3).numpy()


def evaluate(engine: StatevectorEngine, x: Tensor, weights: Tensor) -> Tensor:
    """Expectation values (B, outputs) for inputs x (B, n) in radians and flat weights, on the CPU."""
    return _Simulate.apply(engine, x, weights)
