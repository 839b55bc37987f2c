"""State-vector simulation of the Pauli form in plain PyTorch: any circuit, any device, any derivative.

It is the reference of `compiled.pauli_engine`, and shares with it what comes before and after the state: the angles,
the amplitudes of the start, and the outputs as combinations of the measured values.
"""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from qnerf.quantum import statevector
from qnerf.quantum.circuit import Amplitudes, Circuit, check_state
from qnerf.quantum.expression_table import ExpressionTable
from qnerf.quantum.expressions import Expression
from qnerf.quantum.pauli_form import Word, only_gates, pauli_form

Simulate = Callable[[Tensor, Tensor, Tensor | None, int, torch.dtype], Tensor]
"""Measured values (B, values) from angles (1, fixed) and (B, moving), the start (1 or B, 2^n) or None, B, a dtype."""

KEPT_WIRES = 10  # up to here the tables of a word are kept for the next call: 24 KiB each


class PauliCircuit:
    """A circuit in Pauli form, ready to run in plain PyTorch."""

    def __init__(self, circuit: Circuit) -> None:
        self.circuit, self.form = circuit, pauli_form(circuit)
        angles = [rotation.angle for rotation in self.form.rotations]
        moving = [angle for angle in angles if angle.features]
        self.fixed = ExpressionTable([a for a in angles if not a.features], circuit.parameters, fixed=True)
        self.moving = ExpressionTable(moving, circuit.parameters, fixed=False)
        self.columns: list[tuple[bool, int]] = []  # of each rotation: moves with the input, place among its kind
        counts = [0, 0]
        for angle in angles:
            kind = bool(angle.features)
            self.columns.append((kind, counts[kind]))
            counts[kind] += 1
        self.starts = [_Start(part, circuit) for part in self.form.start]
        self.starts_move = any(not start.table.fixed for start in self.starts)
        used = [*angles, *(Expression.of(angle) for part in self.form.start for angle in part.angles)]
        measures = self.form.combination.shape[1] > 0
        self.takes_all = measures and any(a.features for a in used) and any(a.weights for a in used)
        values = len(self.form.words) + self.form.outcomes
        self.is_identity = self.form.combination.shape == (values, values) and not (
            np.any(self.form.combination != np.eye(values)) or np.any(self.form.constants)
        )

    def evaluate(self, x: Tensor, weights: Tensor, simulate: Simulate | None = None) -> Tensor:
        """Outputs (B, outputs) for inputs x (B, features) and flat weights, by `simulate`."""
        values = x.new_zeros(x.shape[0], 0)
        if self.form.combination.shape[1]:
            fixed, moving = self.fixed(x, weights), self.moving(x, weights)
            values = (simulate or self.simulate)(fixed, moving, self.start(x, weights), x.shape[0], x.dtype)
            values = statevector.clipped(values)
        if not self.takes_all:  # what has no effect has the gradient zero
            values = values + (x[:, :0].sum() + weights[:0].sum()).to(values)
        if self.is_identity:
            return values
        combination = torch.from_numpy(self.form.combination).to(values)
        return values @ combination.T + torch.from_numpy(self.form.constants).to(values)

    def start(self, x: Tensor, weights: Tensor) -> Tensor | None:
        """Amplitudes (1 or B, 2^n) that the circuit starts from, complex128; None for |0...0>."""
        if not self.starts:
            return None
        n = self.circuit.wires
        state, wires = torch.ones(1, 1, dtype=torch.complex128, device=weights.device), []
        for part in self.starts:
            amplitudes = part(x, weights)
            state = (state[:, :, None] * amplitudes[:, None, :]).flatten(1)
            wires += part.wires
        rest = [wire for wire in range(n) if wire not in wires]
        state = torch.nn.functional.pad(state[:, :, None], (0, 2 ** len(rest) - 1)).reshape(-1, *(2,) * n)
        order = np.argsort(wires + rest).tolist()
        return state.permute(0, *(1 + axis for axis in order)).reshape(-1, 2**n)

    def simulate(self, fixed: Tensor, moving: Tensor, start: Tensor | None, batch: int, dtype: torch.dtype) -> Tensor:
        """The measured values, in plain PyTorch."""
        form = self.form
        moving, size = moving.expand(batch, -1), 2**form.wires
        step = max(1, statevector.CHUNK_BYTES // (3 * (len(form.rotations) - form.fixed_rotations + 2) * 16 * size))

        def values(moving: Tensor, *others: Tensor) -> Tensor:
            return self._values(others[-1], moving, others[0] if len(others) > 1 else None, dtype)

        starts = () if start is None else (start.expand(batch, -1) if batch > step else start,)
        return statevector.in_chunks(values, step, (moving, *starts), (fixed,))

    def _values(self, fixed: Tensor, moving: Tensor, start: Tensor | None, dtype: torch.dtype) -> Tensor:
        state = self._final_state(fixed, moving, start, dtype).expand(-1, moving.shape[0])
        values = []
        for word in self.form.words:
            index, phases = action(word, self.form.wires, state.device, state.dtype)
            product = state.conj() * state[index] * phases[:, None]
            values.append(product.real.sum(0))
        if self.form.tables:
            probabilities = state.real.square() + state.imag.square()
            for table in self.form.tables:
                index = torch.from_numpy(table).to(state.device)
                out = probabilities.new_zeros(int(table.max()) + 1, probabilities.shape[1])
                values.extend(out.index_add(0, index, probabilities))
        return torch.stack(values, -1)

    def _final_state(self, fixed: Tensor, moving: Tensor, start: Tensor | None, dtype: torch.dtype) -> Tensor:
        """(2^n, 1 or B)."""
        if start is None:
            state = torch.zeros(2**self.form.wires, 1, dtype=dtype.to_complex(), device=fixed.device)
            state[0] = 1
        else:
            state = start.T.to(dtype.to_complex())
        cosines = [(angles / 2).cos().to(dtype) for angles in (fixed, moving)]
        sines = [(angles / 2).sin().to(dtype) for angles in (fixed, moving)]
        for (word, _), (kind, column) in zip(self.form.rotations, self.columns, strict=True):
            state = _turned(state, word, self.form.wires, cosines[kind][:, column], sines[kind][:, column])
        return state


def gate_by_gate(circuit: Circuit, x: Tensor, weights: Tensor) -> Tensor:
    """The states (B, 2^n) of any circuit at inputs (B, features) and flat weights, up to a phase; complex128.

    Every gate is run. The Pauli form leaves out what has no effect on the values that are measured.

    Raises:
        ValueError: more than 20 wires.
    """
    n = circuit.wires
    check_state(n, f"the whole state of circuit {circuit.name}")
    rotations = [
        (Word.of(part.letters, gate.wires, n), gate.angle_of(part))
        for gate in only_gates(circuit)
        for part in gate.rotations
    ]
    angles = ExpressionTable([angle for _, angle in rotations], circuit.parameters, fixed=False)(x, weights)
    start = PauliCircuit(circuit).start(x, weights)
    if start is None:
        start = torch.nn.functional.pad(torch.ones_like(x[:1, :0].sum(1, keepdim=True)), (0, 2**n - 1))
    state = start.to(torch.complex128).expand(x.shape[0], -1).T
    for column, (word, _) in enumerate(rotations):
        half = angles[:, column] / 2
        state = _turned(state, word, n, half.cos(), half.sin())
    return state.T


def _turned(state: Tensor, word: Word, wires: int, cosine: Tensor, sine: Tensor) -> Tensor:
    """The states (2^n, 1 or B) behind a rotation about `word`, with cosine and sine (1 or B,) of half its angle."""
    index, phases = action(word, wires, state.device, state.dtype)
    return cosine * state + sine * (-1j * phases[:, None] * state[index])


def action(word: Word, wires: int, device: torch.device, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """The word on a state a as (index, phases): phases * a[index]."""
    return (_kept_action if wires <= KEPT_WIRES else _new_action)(word, wires, device, dtype)


def _new_action(word: Word, wires: int, device: torch.device, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    basis = np.arange(2**wires)
    odd = np.bitwise_count((basis ^ word.x) & word.z) & 1
    phases = 1j**word.phase * (1.0 - 2.0 * odd)
    return torch.from_numpy(basis ^ word.x).to(device), torch.from_numpy(phases).to(device, dtype)


_kept_action = lru_cache(maxsize=1024)(torch.inference_mode(False)(_new_action))  # kept for training, too


class _Start:
    """The amplitudes (1 or B, 2^k) of some wires, normalised, complex128."""

    def __init__(self, part: Amplitudes, circuit: Circuit) -> None:
        expressions = [Expression.of(value) for value in part.angles]
        fixed = not any(expression.features for expression in expressions)
        self.wires, self.size = list(part.wires), len(part.real)
        self.table = ExpressionTable(expressions, circuit.parameters, fixed)

    def __call__(self, x: Tensor, weights: Tensor) -> Tensor:
        values = self.table(x, weights)
        norm = values.square().sum(1, keepdim=True).sqrt()
        values = values / norm
        real, imaginary = values[:, : self.size], values[:, self.size :]
        return torch.complex(real, imaginary if imaginary.shape[1] else torch.zeros_like(real))
