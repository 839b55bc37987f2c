"""The compiled state-vector engine: any circuit, CPU, float32 and float64, adjoint differentiation of its own.

Once a step, the angles become tables (`tables.bind`), and the part of the circuit before the first data is applied to
one state. Then every block of samples goes through the rest of the circuit (`sweeps`). A last RY layer is not applied;
it only rotates what is measured. Between forward and backward only <Z> and <X> are stored: memory does not depend on
the number of gates.

Sums over samples are taken over a fixed number of parts in a fixed order, so results do not depend on the number of
threads. The reference is `statevector.PlainCircuit`.
"""

from math import frexp
from typing import Any

import numpy as np
import torch
from torch import Tensor

from qnerf.kernels.derivatives import is_differentiated, through_reference
from qnerf.kernels.jit import loop_threads, run
from qnerf.kernels.simd import VECTOR_BYTES, lanes
from qnerf.quantum.circuit import Circuit
from qnerf.quantum.compiled.sweeps import Moving, backward, forward, prepare_backward
from qnerf.quantum.compiled.tables import FIXED, Extra, Measurement, ProgramArrays, Tables, bind
from qnerf.quantum.compiled.work_array import Shape
from qnerf.quantum.program import Program
from qnerf.quantum.statevector import PlainCircuit

PARTS = 32  # sums of gradients over a batch
STORED_BYTES = 2**26  # of the states that a thread stores; beyond, operations are taken off the state


class Engine:
    """A circuit ready to run on the CPU, without its angles."""

    def __init__(self, circuit: Circuit) -> None:
        self.plain = PlainCircuit(circuit)
        self.program, self.angles = self.plain.program, self.plain.angles
        self.arrays = ProgramArrays(self.program, self.angles)
        self.values = len(self.arrays.masks) + len(self.arrays.words) + int(self.arrays.firsts[-1])

    def evaluate(self, x: Tensor, weights: Tensor) -> Tensor:
        """Outputs (B, outputs) for inputs x (B, features) in radians and flat weights."""
        return self.plain.evaluate(x, weights, self.simulate)

    def simulate(self, fixed: Tensor, inputs: Tensor, start: Tensor | None, batch: int, dtype: torch.dtype) -> Tensor:
        """The measured values, as `PlainCircuit.simulate` gives them."""
        out: Tensor = _Simulate.apply(self, fixed, inputs, start, batch, dtype)
        return out


def work_bytes(program: Program, batch: int, itemsize: int = 4) -> int:
    """Bytes of work space, at most: a block of samples for each thread."""
    blocks = -(-batch * itemsize // VECTOR_BYTES)
    state = 2 * 2**program.wires * VECTOR_BYTES
    stored = min((len(program.blocks) + 2) * state, max(STORED_BYTES, 2 * state))
    starts = 2 * blocks * state if program.start_moves else 0
    values = len(program.words) + sum(program.outcomes) + 3 * (program.circuit.features or 0)
    return min(loop_threads(), blocks) * (stored + 6 * state) + starts + blocks * values * VECTOR_BYTES


class _Run:
    """The arrays of one step, with its angles. It takes NumPy arrays in blocks of `lanes` samples."""

    def __init__(
        self, engine: Engine, fixed: Tensor, inputs: Tensor, start: Tensor | None, batch: int, dtype: torch.dtype
    ) -> None:
        arrays, self.engine, self.batch = engine.arrays, engine, batch
        self.kind: Any = np.float32 if dtype == torch.float32 else np.float64
        n, self.n, self.width = arrays.n, arrays.n, lanes(np.dtype(self.kind).itemsize)
        angles, x = fixed.detach().numpy()[0], inputs.detach().numpy()
        stored = arrays.stored_states * 2 * (self.width << n) * np.dtype(self.kind).itemsize <= STORED_BYTES
        self.stored = np.bool_(stored)
        self.shape = Shape(n, self.width, max(2, arrays.stored_states) if stored else 2, x.shape[1])
        self.count = len(angles)
        frame = self._bind(angles)
        blocks = to_blocks(x if len(x) == batch else np.broadcast_to(x, (batch, x.shape[1])), self.width)
        self.moving = Moving(self._trig(blocks), arrays.singles)
        starts = np.zeros((0, 2, 2**n, self.width), self.kind)
        self.first = np.zeros((2, 2**n), self.kind)
        self.first[0, 0] = self.amplitude
        if start is not None:
            amplitudes = start.detach().numpy()
            if engine.program.start_moves:
                amplitudes = np.broadcast_to(amplitudes, (batch, 2**n))
                parts = [to_blocks(part, self.width) for part in (amplitudes.real, amplitudes.imag)]
                starts = np.stack(parts, 1).astype(self.kind)
            else:
                self.first = (np.stack([amplitudes[0].real, amplitudes[0].imag]) * self.amplitude).astype(self.kind)
        self.extra = None if arrays.is_plain else self._extra(angles, frame, starts)

    def _bind(self, angles: np.ndarray) -> np.ndarray:
        arrays, n, kind = self.engine.arrays, self.n, self.kind
        diagonals, operations = len(arrays.steps.constants), len(arrays.steps.operations)
        tables = Tables(
            np.zeros((arrays.layers, n)), np.empty((diagonals, 2, 2**n)), np.empty(operations, np.int64),
            np.zeros(len(arrays.steps.taps)), np.empty(operations), arrays.permutations,
        )  # fmt: skip
        frame = np.empty((len(arrays.steps.turns) + 1, 2), np.int64)
        self.measurement = Measurement(
            arrays.measures_last_layer, arrays.masks, np.empty(len(arrays.masks), kind), np.empty((4, n), kind)
        )
        spare = np.empty((2, 2**n))
        self.amplitude = bind(arrays.steps, angles, n, spare, self.measurement, tables, frame)
        self.tables = Tables(tables.tangents.astype(kind), tables.diagonals.astype(kind), *tables[2:])
        self.factors = (arrays.factors * tables.signs).astype(kind)
        return frame

    def _extra(self, angles: np.ndarray, frame: np.ndarray, starts: np.ndarray) -> Extra:
        arrays = self.engine.arrays
        turns, words = arrays.steps.turns.copy(), arrays.words.copy()
        for rows, own in ((turns, frame[:-1]), (words, frame[-1:])):
            rows[:, 3] ^= (np.bitwise_count(rows[:, 0] & own[:, 1]) ^ np.bitwise_count(rows[:, 1] & own[:, 0])) & 1
        fixed = np.stack([np.cos(angles / 2), np.sin(angles / 2)]).astype(self.kind)
        outcomes = np.ascontiguousarray(arrays.outcomes[:, np.arange(2**self.n) ^ frame[-1, 0]])
        return Extra(turns, fixed, arrays.products, words, outcomes, arrays.firsts, starts)

    def _trig(self, blocks: np.ndarray) -> np.ndarray:
        """cos and sin of half the moving angles: (blocks, columns, width) -> (blocks, 2, M, width)."""
        own = self.engine.angles.inputs
        out = np.empty((blocks.shape[0], 2, len(own.columns), self.width), self.kind)
        same = own.columns == list(range(blocks.shape[1]))
        cos_sin(blocks if same else blocks[:, own.columns], 0.5 * np.array(own.factors), out.swapaxes(0, 1))
        return out

    def _shared_arguments(self) -> tuple[Any, ...]:
        """Arguments that `forward` and `backward` begin with."""
        arrays, parts = self.engine.arrays, self.parts
        return (
            parts, parts, arrays.applied, arrays.once, self.shape, self.moving, self.first, self.tables,
            self.measurement, self.extra,
        )  # fmt: skip

    @property
    def blocks(self) -> int:
        return self.moving.trig.shape[0]

    @property
    def parts(self) -> int:
        """Into how many parts sums over the samples are split, whatever the number of threads."""
        return min(PARTS, max(self.blocks, 1))

    def forward(self) -> np.ndarray:
        """(blocks, values, width)."""
        blocks = self.blocks if self.engine.program.measures_last_layer else 0
        self.expectations = np.empty((blocks, 2, self.n, self.width), self.kind)
        out = np.empty((self.blocks, self.engine.values, self.width), self.kind)
        run(forward, *self._shared_arguments(), self.expectations, out)
        return out

    def backward(self, gradient: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Gradients of the fixed angles (F,), the inputs (blocks, K, width) and the start or starts."""
        arrays, n, parts = self.engine.arrays, self.n, self.parts
        steps, taps, moves = arrays.steps, arrays.steps.taps, self.engine.program.start_moves
        inputs = np.empty((self.blocks, self.shape.columns, self.width), self.kind)
        sums, adjoints = np.zeros((parts, len(taps))), np.zeros((parts, 2, 2**n))
        starts = np.zeros((self.blocks if moves else 0, 2, 2**n, self.width), self.kind)
        run(
            backward, *self._shared_arguments(), self.expectations, arrays.last_taps, taps, self.factors, gradient,
            self.stored, inputs, sums, adjoints, starts,
        )  # fmt: skip
        total, adjoint = sums.sum(0), adjoints.sum(0)
        prepare_backward(
            steps.operations[: arrays.once], self.shape, taps, self.factors, self.tables, self.extra, self.first,
            adjoint, total, self.stored,
        )  # fmt: skip
        # Taps without a fixed angle, number -1, are counted before all others.
        fixed = np.bincount(taps[:, FIXED] + 1, total * self.tables.signs, self.count + 1)[1:]
        return fixed, inputs, starts if moves else adjoint * self.amplitude


# The functions below take NumPy arrays rather than tensors. The arrays are small, and torch would wake its OpenMP
# threads for them, which on a busy machine takes far longer than the work.
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
    """out[0], out[1] = cos, sin of the inputs (blocks, n, width) times factors (n,); infinity gives NaN.

    As in `statevector.cos_sin`, a product that the inputs' dtype would round is taken in float64.
    """
    exact = all(abs(frexp(factor)[0]) in (0, 0.5) for factor in factors.tolist())
    angles = factors[:, None].astype(x.dtype if exact else np.float64) * x
    with np.errstate(invalid="ignore"):
        np.cos(angles, out=out[0], casting="same_kind")
        np.sin(angles, out=out[1], casting="same_kind")


class _Simulate(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, engine: Engine, fixed: Tensor, inputs: Tensor, start: Tensor | None, batch: int, dtype: torch.dtype
    ) -> Tensor:
        ctx.run = _Run(engine, fixed, inputs, start, batch, dtype)
        ctx.dtype = dtype
        ctx.save_for_backward(fixed, inputs, *([] if start is None else [start]))
        out = ctx.run.forward()
        # Rounding may lead beyond. PyTorch would share this with threads, which then spin beside the loops.
        return from_blocks(np.clip(out, -1, 1, out=out), batch)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        own: _Run = ctx.run
        saved = ctx.saved_tensors
        if is_differentiated(gradient):

            def reference(fixed: Tensor, inputs: Tensor, start: Tensor | None = None) -> Tensor:
                return own.engine.plain.simulate(fixed, inputs, start, own.batch, ctx.dtype)

            gradients = through_reference(reference, saved, gradient)
            return None, *gradients, *[None] * (5 - len(saved))
        upstream = to_blocks(gradient.detach().resolve_neg().numpy().astype(own.kind, copy=False), own.width)
        total, inputs, starts = own.backward(upstream)
        to_inputs = to_start = None
        if ctx.needs_input_grad[2]:
            to_inputs = from_blocks(inputs, own.batch).to(saved[1].dtype)
            if saved[1].shape[0] != own.batch:
                to_inputs = to_inputs.sum(0, keepdim=True)
        if len(saved) > 2:
            parts = 2 * torch.from_numpy(starts).double()
            if own.engine.program.start_moves:
                parts = parts.permute(0, 3, 1, 2).reshape(-1, 2, parts.shape[2])[: own.batch]
            else:
                parts = parts[None]
            complexes = torch.complex(parts[:, 0], parts[:, 1])
            to_start = complexes if saved[2].shape[0] == len(complexes) else complexes.sum(0, keepdim=True)
        return None, torch.from_numpy(total)[None], to_inputs, to_start, None, None
