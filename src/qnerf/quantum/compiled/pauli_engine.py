"""The compiled engine of the Pauli form: any circuit, CPU, float32 and float64, adjoint differentiation of its own.

The reference is `pauli_statevector`. Sums over samples are taken over a fixed number of parts in a fixed order, so
results do not depend on the number of threads.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from qnerf.kernels.derivatives import is_differentiated, through_reference
from qnerf.kernels.jit import run
from qnerf.kernels.simd import lanes
from qnerf.quantum.compiled import pauli_sweeps
from qnerf.quantum.compiled.engine import from_blocks, numpy_dtype, parts_of, to_blocks
from qnerf.quantum.compiled.pauli_sweeps import PauliArrays, StepArrays
from qnerf.quantum.pauli_form import Word
from qnerf.quantum.pauli_statevector import PauliCircuit


class PauliEngine:
    """A circuit in Pauli form, ready to run on the CPU."""

    def __init__(self, plain: PauliCircuit) -> None:
        form = plain.form
        self.plain, self.form = plain, form
        rows = [(*_row(r.word), *column) for r, column in zip(form.rotations, plain.columns, strict=True)]
        sizes = [int(table.max()) + 1 for table in form.tables]
        self.arrays = PauliArrays(
            np.array(rows, dtype=np.int64).reshape(-1, 6),
            np.array([_row(word) for word in form.words], dtype=np.int64).reshape(-1, 4),
            np.array(form.tables, dtype=np.int64).reshape(len(form.tables), 2**form.wires),
            np.cumsum([0, *sizes]).astype(np.int64),
        )

    def evaluate(self, x: Tensor, weights: Tensor) -> Tensor:
        """Outputs (B, outputs) for inputs x (B, features) and flat weights, compiled."""
        return self.plain.evaluate(x, weights, self._simulate)

    def _simulate(self, fixed: Tensor, moving: Tensor, start: Tensor | None, batch: int, dtype: torch.dtype) -> Tensor:
        out: Tensor = _Simulate.apply(self, fixed, moving, start, batch, dtype)
        return out


def _row(word: Word) -> tuple[int, int, int, int]:
    return word.x, word.z, word.phase % 2, word.phase // 2


class _Run:
    """The arrays of one step."""

    def __init__(
        self, engine: PauliEngine, fixed: Tensor, moving: Tensor, start: Tensor | None, batch: int, dtype: torch.dtype
    ) -> None:
        kind = numpy_dtype(dtype)
        form = engine.form
        self.engine, self.kind = engine, kind
        n, self.width = form.wires, lanes(np.dtype(kind).itemsize)
        self.n, self.batch = n, batch
        # What runs once a step is float64: it costs nothing, and its gradients are sums over the whole batch.
        self.fixed_once = _cos_sin(fixed.detach().numpy()[0], np.float64)
        angles = np.broadcast_to(moving.detach().numpy(), (batch, moving.shape[1]))
        trig = np.ascontiguousarray(_cos_sin(to_blocks(angles, self.width), kind).swapaxes(0, 1))
        self.once = np.zeros((2, 2**n))
        self.once[0, 0] = 1
        starts = np.zeros((0, 2, 2**n, self.width), kind)
        self.each_its_own = start is not None and start.shape[0] == batch and batch != 1
        if start is not None:
            amplitudes = start.detach().numpy()
            if self.each_its_own:
                parts = [to_blocks(part, self.width) for part in (amplitudes.real, amplitudes.imag)]
                starts = np.stack(parts, 1).astype(kind)
            else:
                self.once = np.stack([amplitudes[0].real, amplitudes[0].imag]).astype(np.float64)
        count = 0 if self.each_its_own else form.fixed_rotations
        if count:
            pauli_sweeps.prepare(engine.arrays.rotations, count, n, lanes(8), self.fixed_once, self.once)
        self.step = StepArrays(count, self.fixed_once.astype(kind), trig, self.once.astype(kind), starts)

    def _arguments(self) -> tuple[Any, ...]:
        parts = parts_of(self.step.trig)
        return parts, parts, self.n, self.width, self.engine.arrays, self.step

    def forward(self) -> Tensor:
        values = len(self.engine.arrays.words) + self.engine.arrays.outcomes[-1]
        out = np.empty((self.step.trig.shape[0], values, self.width), self.kind)
        run(pauli_sweeps.forward, *self._arguments(), out)
        return from_blocks(out, self.batch)

    def backward(self, gradient: np.ndarray) -> tuple[Tensor, Tensor, np.ndarray]:
        """Gradients of the fixed angles (1, fixed), the moving ones (B, moving), and of the start (1 or B, 2, 2^n)."""
        step, parts = self.step, parts_of(self.step.trig)
        moving = np.zeros((step.trig.shape[0], step.trig.shape[2], self.width), self.kind)
        sums, adjoints = np.zeros((parts, step.fixed.shape[1])), np.zeros((parts, *step.shared.shape))
        starts = np.zeros_like(step.starts)
        run(
            pauli_sweeps.backward, *self._arguments(), to_blocks(gradient.astype(self.kind), self.width), moving, sums,
            adjoints, starts,
        )  # fmt: skip
        total, adjoint = sums.sum(0), adjoints.sum(0)
        if step.count:
            rotations = self.engine.arrays.rotations
            pauli_sweeps.prepare_backward(
                rotations, step.count, self.n, lanes(8), self.fixed_once, self.once.copy(), adjoint, total
            )
        if self.each_its_own:
            to_start = starts.transpose(0, 3, 1, 2).reshape(-1, 2, 2**self.n)[: self.batch]
        else:
            to_start = 2 * adjoint[None]
        return torch.from_numpy(total)[None], from_blocks(moving, self.batch).double(), to_start


def _cos_sin(angles: np.ndarray, kind: Any) -> np.ndarray:
    """(2, *shape): cos and sin of half the angles, which are float64."""
    half = angles * 0.5
    with np.errstate(invalid="ignore"):  # infinity gives NaN
        return np.stack([np.cos(half), np.sin(half)]).astype(kind)


class _Simulate(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, engine: PauliEngine, fixed: Tensor, moving: Tensor, start: Tensor | None, batch: int,
        dtype: torch.dtype,
    ) -> Tensor:  # fmt: skip
        step = _Run(engine, fixed, moving, start, batch, dtype)
        ctx.save_for_backward(fixed, moving, *([] if start is None else [start]))
        ctx.step, ctx.dtype = step, dtype
        return step.forward()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        step: _Run = ctx.step
        inputs = ctx.saved_tensors
        if is_differentiated(gradient):

            def reference(fixed: Tensor, moving: Tensor, start: Tensor | None = None) -> Tensor:
                return step.engine.plain.simulate(fixed, moving, start, step.batch, ctx.dtype)

            gradients = through_reference(reference, inputs, gradient)
        else:
            fixed, moving, to_start = step.backward(gradient.detach().resolve_neg().numpy())
            moving = moving if inputs[1].shape[0] == step.batch else moving.sum(0, keepdim=True)
            gradients = [fixed, moving]
            if len(inputs) > 2:
                parts = torch.from_numpy(to_start).double()
                complexes = torch.complex(parts[:, 0], parts[:, 1])
                gradients.append(complexes if inputs[2].shape[0] == len(complexes) else complexes.sum(0, keepdim=True))
        return None, gradients[0], gradients[1], gradients[2] if len(inputs) > 2 else None, None, None
