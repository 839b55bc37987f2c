"""State-vector simulation in plain PyTorch: any circuit, any device, any derivative. The reference of the engine.

The state is complex (2^n, B), amplitudes first. Up to the first data B is 1, so that part runs once for the whole
batch. A diagonal is one complex product; a layer of RY is a few real matrix products on groups of wires. Large batches
go through in chunks that are computed again in the backward pass, so that peak memory does not grow with the batch.

On a GPU, what lies between two blocks of data is one matrix (`dense`): the blocks run once a step on the identity.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache, reduce
from math import frexp
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from qnerf.kernels import is_transformed
from qnerf.quantum.angles import Angles, ExpressionTable
from qnerf.quantum.basis import bit, cnot_permutation, placed, z_signs
from qnerf.quantum.blocks import CNOTs, Diagonal, Tilts, Turn, moves
from qnerf.quantum.circuit import Amplitudes, Circuit, check_state
from qnerf.quantum.expressions import Expression
from qnerf.quantum.program import Program, program, unmerged
from qnerf.quantum.words import Word

GROUP = 4  # wires in one dense real matrix
CHUNK_BYTES = 2**28  # what autograd may store for one chunk
KEPT_WIRES = 10  # up to here the tables of a word are kept for the next call: 24 KiB each
DENSE_WIRES = 10  # up to here a GPU takes dense blocks

Simulate = Callable[[Tensor, Tensor, Tensor | None, int, torch.dtype], Tensor]
"""Measured values (B, values) from fixed angles (1, F), inputs (B, K), the start (1 or B, 2^n) or None, B, a dtype."""

Turns = tuple[Tensor, Tensor]
"""cos and sin of half an angle for many angles: (angles, 1) or (angles, B)."""


class PlainCircuit:
    """A circuit ready to run in plain PyTorch, by its own program or another one."""

    def __init__(self, circuit: Circuit, own: Program | None = None) -> None:
        self.circuit, self.program = circuit, own or program(circuit)
        self.angles = Angles(self.program)
        self.starts = [_Start(part, circuit) for part in self.program.start]

    def evaluate(self, x: Tensor, weights: Tensor, simulate: Simulate | None = None) -> Tensor:
        """Outputs (B, outputs) for inputs x (B, features) and flat weights, by `simulate`."""
        form = self.program
        values = x.new_zeros(x.shape[0], 0)
        if form.words or form.tables:
            fixed, inputs = self.angles.fixed(x, weights), self.angles.inputs(x, weights)
            values = (simulate or self.simulate)(fixed, inputs, self.start(x, weights), x.shape[0], x.dtype)
        if not self.angles.takes_all:  # what has no effect has the gradient zero
            values = values + (x[:, :0].sum() + weights[:0].sum()).to(values)
        return form.outputs(values)

    def start(self, x: Tensor, weights: Tensor) -> Tensor | None:
        """Amplitudes (1 or B, 2^n) that the circuit starts from, complex128; None for |0...0>."""
        if not self.starts:
            return None
        n = self.circuit.wires
        state, *others = (part(x, weights) for part in self.starts)
        for amplitudes in others:
            state = (state[:, :, None] * amplitudes[:, None, :]).flatten(1)
        wires = [wire for part in self.starts for wire in part.wires]
        if wires == list(range(n)):
            return state
        rest = [wire for wire in range(n) if wire not in wires]
        state = torch.nn.functional.pad(state[:, :, None], (0, 2 ** len(rest) - 1)).reshape(-1, *(2,) * n)
        order = np.argsort(wires + rest).tolist()
        return state.permute(0, *(1 + axis for axis in order)).reshape(-1, 2**n)

    def simulate(self, fixed: Tensor, inputs: Tensor, start: Tensor | None, batch: int, dtype: torch.dtype) -> Tensor:
        """The measured values, in plain PyTorch."""
        size = chunk_size(self.program, dtype.itemsize)
        inputs = inputs.expand(batch, -1)

        def values(inputs: Tensor, *others: Tensor) -> Tensor:
            state = self.final_state(others[-1], inputs, others[0] if len(others) > 1 else None, dtype)
            return clipped(_measured(self.program, state))

        starts = () if start is None else (start.expand(batch, -1) if batch > size else start,)
        return in_chunks(values, size, (inputs, *starts), (fixed,))

    def final_state(self, fixed: Tensor, inputs: Tensor, start: Tensor | None, dtype: torch.dtype) -> Tensor:
        """The state (2^n, B) behind all blocks, up to a phase."""
        n = self.program.wires
        if start is None:
            state = torch.zeros(2**n, 1, dtype=dtype.to_complex(), device=fixed.device)
            state[0] = 1
        else:
            state = start.T.to(dtype.to_complex())
        moving = self.moving(inputs, dtype)
        half = fixed[0, :, None] / 2
        still = half.cos().to(dtype), half.sin().to(dtype)
        if takes_dense_blocks(inputs.device, n):
            state = self.dense(state, still, moving)
        else:
            for place in range(len(self.program.blocks)):
                state = self.applied(place, state, still, moving)
        return state.expand(-1, inputs.shape[0])

    def moving(self, inputs: Tensor, dtype: torch.dtype) -> Turns:
        """cos and sin (M, B) of half the angles that move with the inputs (B, K)."""
        own = self.angles.inputs
        cosine, sine = cos_sin(picked(inputs, own.columns, 1), [factor / 2 for factor in own.factors])
        return cosine.to(dtype), sine.to(dtype)

    def applied(self, place: int, state: Tensor, still: Turns, moving: Turns) -> Tensor:
        """The states (2^n, 1 or B) behind one block; `still` and `moving` as of `final_state`."""
        block, n = self.program.blocks[place], self.program.wires
        if isinstance(block, CNOTs):
            return state[table(cnot_permutation, tuple(block.pairs), n, state.device, None)]
        if isinstance(block, Diagonal):
            return self.moved_phases(place, self.fixed_phases(place, state, still), moving)
        rows = self.angles.rotations[place]
        if isinstance(block, Turn):
            ((word, own, other),) = rows
            cosine, sine = still if other < 0 else moving
            return _turned(state, word, n, *(part[own if other < 0 else other] for part in (cosine, sine)))
        own_angles = {word.x: own for word, own, _ in rows}
        index = [own_angles.get(bit(wire, n), -1) for wire in range(n)]
        padded = (
            torch.nn.functional.pad(part, (0, 0, 0, 1), value=none)
            for part, none in zip(still, (1.0, 0.0), strict=True)
        )
        cosine, sine = (picked(part, index, 0)[:, 0] for part in padded)
        return _apply_layer(state, cosine, sine, isinstance(block, Tilts))

    def fixed_phases(self, place: int, state: Tensor, still: Turns) -> Tensor:
        """The states behind the part of a diagonal that does not depend on the input."""
        rows = [(word.z, own) for word, own, _ in self.angles.rotations[place] if own >= 0]
        constant = self.angles.phases[place]
        if constant is not None:
            state = state * placed(constant, state.device, state.dtype)[:, None]
        return state * _phases(rows, still, self.program.wires) if rows else state

    def moved_phases(self, place: int, state: Tensor, moving: Turns) -> Tensor:
        """The states behind the part of a diagonal that depends on the input."""
        rows = [(word.z, other) for word, _, other in self.angles.rotations[place] if other >= 0]
        return state * _phases(rows, moving, self.program.wires) if rows else state

    def dense(self, state: Tensor, still: Turns, moving: Turns) -> Tensor:
        """The state (2^n, B): what lies between two blocks of data is a matrix, made by running it on the identity."""
        blocks, n = self.program.blocks, self.program.wires
        for place in range(self.program.fixed_blocks):
            state = self.applied(place, state, still, moving)
        one = torch.eye(2**n, dtype=state.dtype, device=state.device)
        matrix, is_one = one, True
        for place in range(self.program.fixed_blocks, len(blocks)):
            block = blocks[place]
            if moves(block):
                state = state if is_one else matrix @ state
                matrix, is_one = one, True
                if isinstance(block, Turn):
                    state = self.applied(place, state, still, moving)
                    continue
                state = self.moved_phases(place, state, moving)
                matrix = self.fixed_phases(place, matrix, still)
            else:
                matrix = self.applied(place, matrix, still, moving)
            is_one = False
        return state if is_one else matrix @ state


def takes_dense_blocks(device: torch.device, wires: int) -> bool:
    """Whether a matrix for what lies between two blocks of data is cheaper than the blocks: on a GPU, of few wires."""
    return device.type == "cuda" and wires <= DENSE_WIRES


def picked(tensor: Tensor, places: list[int], dim: int) -> Tensor:
    """The rows or columns of a tensor at these places."""
    if places == list(range(tensor.shape[dim])):
        return tensor
    if not places:
        return tensor.narrow(dim, 0, 0)
    return torch.stack([tensor.select(dim, place) for place in places], dim)


def chunk_size(form: Program, itemsize: int) -> int:
    """How many samples autograd can store in CHUNK_BYTES, at least 1."""
    stored_states = 3 * (len(form.blocks) - form.fixed_blocks + 2)
    return max(1, CHUNK_BYTES // (stored_states * 2 * itemsize * 2**form.wires))


def in_chunks(
    function: Callable[..., Tensor], size: int, moving: tuple[Tensor, ...], shared: tuple[Tensor, ...]
) -> Tensor:
    """`function(*moving, *shared)` for `size` samples at a time; `moving` tensors have a row for each sample.

    Where gradients are wanted, a chunk is computed again in the backward pass.
    """
    if len(moving[0]) <= size:
        return function(*moving, *shared)
    parts = zip(*(tensor.split(size) for tensor in moving), strict=True)
    tensors = *moving, *shared
    stores = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    if not stores or is_transformed(*tensors):  # `torch.func` does not know checkpoints
        return torch.cat([function(*part, *shared) for part in parts])
    options: dict[str, Any] = {"use_reentrant": False, "preserve_rng_state": False}
    return torch.cat([checkpoint(function, *part, *shared, **options) for part in parts])


def _measured(form: Program, state: Tensor) -> Tensor:
    """The values (B, values) that are measured in states (2^n, B)."""
    probabilities = state.real.square() + state.imag.square()
    masks = tuple(word.z for word in form.words if not word.x)
    signs = table(z_signs, masks, form.wires, state.device, probabilities.dtype)
    products = iter((signs @ probabilities).unbind(0))
    values = []
    for word in form.words:
        if word.x:
            index, phases = action(word, form.wires, state.device, state.dtype)
            values.append((state.conj() * state[index] * phases[:, None]).real.sum(0))
        else:
            values.append(next(products))
    for outcomes in form.tables:
        out = probabilities.new_zeros(int(outcomes.max()) + 1, probabilities.shape[1])
        values.extend(out.index_add(0, placed(outcomes, state.device), probabilities))
    return torch.stack(values, -1)


def clipped(values: Tensor) -> Tensor:
    """The values within [-1, 1], which rounding may leave; gradients pass as they are."""
    return values + (values.clamp(-1, 1) - values).detach()


def cos_sin(x: Tensor, factors: Sequence[float]) -> Turns:
    """cos and sin (n, B) of the inputs x (B, n) in radians times a factor for each column.

    A product that the dtype of the inputs would round is taken in float64: at an angle of 1e3 the rounding alone would
    be an error of 1e-4.
    """
    exact = all(abs(frexp(factor)[0]) in (0, 0.5) for factor in factors)
    angles = (x if exact else x.double()).T
    angles = angles * placed(_numbers(tuple(factors)), angles.device, angles.dtype)[:, None]
    return angles.cos().to(x.dtype), angles.sin().to(x.dtype)


@lru_cache(maxsize=1024)
def _numbers(values: tuple[float, ...]) -> np.ndarray:
    return np.array(values, np.float64)


def _phases(rows: list[tuple[int, int]], turns: Turns, n: int) -> Tensor:
    """Phases (2^n, 1 or B) of rotations about products of Z: (mask, number of the angle)."""
    cosine, sine = turns
    singles = {mask: own for mask, own in rows if mask.bit_count() == 1}
    phases = torch.ones(1, 1, dtype=cosine.dtype.to_complex(), device=cosine.device)
    for wire in range(n):
        own = singles.get(1 << (n - 1 - wire))
        if own is None:
            phases = phases.repeat_interleave(2, 0)
            continue
        factor = torch.complex(cosine[own], -sine[own])  # of bit 0; bit 1 has the conjugate
        phases = torch.stack([phases * factor, phases * factor.conj()], dim=1).flatten(0, 1)
    for mask, own in rows:
        if mask.bit_count() > 1:
            signs = table(z_signs, (mask,), n, cosine.device, cosine.dtype)[0, :, None]
            phases = phases * torch.complex(cosine[own].expand(2**n, -1), -sine[own] * signs)
    return phases


def _apply_layer(state: Tensor, cosine: Tensor, sine: Tensor, about_x: bool) -> Tensor:
    """Rotations about Y, or about X, on every wire, with cosine and sine (n,) of half the angles."""
    if about_x:
        cosine, sine = cosine.to(state.dtype), -1j * sine
    single = torch.stack([cosine, sine if about_x else -sine, sine, cosine], 1).reshape(-1, 2, 2)
    amplitudes = state if about_x else torch.view_as_real(state.contiguous())
    for first in range(0, len(single), GROUP):
        matrix = reduce(torch.kron, single[first : first + GROUP])
        view = amplitudes.reshape(2**first, len(matrix), -1)
        amplitudes = torch.matmul(matrix, view).reshape(amplitudes.shape)
    return amplitudes if about_x else torch.view_as_complex(amplitudes)


def table(
    build: Callable[[Any, int], np.ndarray], gates: Any, wires: int, device: torch.device, dtype: torch.dtype | None
) -> Tensor:
    """`build(gates, wires)` on a device; `dtype` None keeps its own."""
    return placed(_array(build, gates, wires), device, dtype)


@lru_cache(maxsize=1024)
def _array(build: Callable[[Any, int], np.ndarray], gates: Any, wires: int) -> np.ndarray:
    return build(gates, wires)


def gate_by_gate(circuit: Circuit, x: Tensor, weights: Tensor) -> Tensor:
    """The states (B, 2^n) of any circuit at inputs (B, features) and flat weights, up to a phase; complex128.

    Every gate is run. A program leaves out what has no effect on the values that are measured.

    Raises:
        ValueError: more than 20 wires.
    """
    check_state(circuit.wires, f"the whole state of circuit {circuit.name}")
    plain = PlainCircuit(circuit, unmerged(circuit))
    fixed, inputs, start = plain.angles.fixed(x, weights), plain.angles.inputs(x, weights), plain.start(x, weights)
    return plain.final_state(fixed, inputs.expand(x.shape[0], -1), start, torch.float64).T


def _turned(state: Tensor, word: Word, wires: int, cosine: Tensor, sine: Tensor) -> Tensor:
    """The states (2^n, 1 or B) behind a rotation about `word`, with cosine and sine (1 or B,) of half its angle."""
    index, phases = action(word, wires, state.device, state.dtype)
    return cosine * state + sine * (-1j * phases[:, None] * state[index])


def action(word: Word, wires: int, device: torch.device, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """The word on a state a as (index, phases): phases * a[index]."""
    if wires > KEPT_WIRES:
        index, phases = (torch.from_numpy(part) for part in (_moved(word, wires), _moved_phases(word, wires)))
        return index.to(device), phases.to(device, dtype)
    return table(_moved, word, wires, device, None), table(_moved_phases, word, wires, device, dtype)


def _moved(word: Word, wires: int) -> np.ndarray:
    return np.arange(2**wires) ^ word.x


def _moved_phases(word: Word, wires: int) -> np.ndarray:
    odd = np.bitwise_count((np.arange(2**wires) ^ word.x) & word.z) & 1
    out: np.ndarray = 1j**word.phase * (1.0 - 2.0 * odd)
    return out


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
        return torch.complex(real, imaginary) if imaginary.shape[1] else real.to(torch.complex128)
