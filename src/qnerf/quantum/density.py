"""Exact outputs of noisy circuits by density matrices, in plain PyTorch (complex128).

The density matrices (2^n, 2^n, B) run forward to the last gate that takes a feature, with B = 1 up to the first one.
The observables are carried back to the same place by the adjoint channels, once for all samples. What does not depend
on the input is thus computed once. Noise does not widen the light cones of gates that are not merged, so circuits with
small cones need the interpolation grid alone.
"""

from collections.abc import Callable, Sequence
from functools import reduce

import torch
from torch import Tensor

from qnerf.config import memory
from qnerf.quantum.angles import ExpressionTable
from qnerf.quantum.basis import bit, cnot_permutation, cz_signs
from qnerf.quantum.circuit import Circuit, Expression, Gate, Observable, Probabilities, as_sum
from qnerf.quantum.cones import TooLarge, cones_of_outputs
from qnerf.quantum.lightcone import LightCones, interpolation, polynomials
from qnerf.quantum.noise import Noise
from qnerf.quantum.program import unmerged
from qnerf.quantum.statevector import PlainCircuit, action
from qnerf.quantum.words import Word

CHUNK_BYTES = 2**27
SECONDS = 3.7e-8  # for each entry of a density matrix and each factor of a gate or channel, one core
QUICK_GRID, QUICK_SAMPLE = 60.0, 2e-3  # seconds

_PAULIS = {
    "I": torch.eye(2, dtype=torch.complex128),
    "X": torch.tensor([[0, 1], [1, 0]], dtype=torch.complex128),
    "Y": torch.tensor([[0, -1j], [1j, 0]], dtype=torch.complex128),
    "Z": torch.tensor([[1, 0], [0, -1]], dtype=torch.complex128),
}


def evaluate(circuit: Circuit, x: Tensor, weights: Tensor, noise: Noise, cache: dict[bytes, Tensor]) -> Tensor:
    """Noisy outputs (B, outputs) for x (B, features), without gradients; errors of the readout are not among them.

    The weights are flat. `cache` takes the coefficients of circuits with small light cones, so that only the first
    batch pays for them.
    """
    x64, w64 = x.detach().double().cpu(), weights.detach().double().cpu()
    try:
        cones = LightCones(cones_of_outputs(unmerged(circuit)))
    except TooLarge:
        return _evaluate_directly(circuit, x64, w64, noise).to(x)
    points = torch.from_numpy(cones.grid.points)
    key = repr((circuit, noise)).encode() + w64.contiguous().numpy().tobytes()
    if key not in cache:
        if len(points) >= x.shape[0]:
            return _evaluate_directly(circuit, x64, w64, noise).to(x)
        cache[key] = cones.coefficients(_evaluate_directly(circuit, points, w64, noise))
    return polynomials(cones.form, x.detach(), cache[key].to(x))


def is_quick(circuit: Circuit) -> bool:
    """Whether it takes at most a minute once, for circuits with small cones, or two milliseconds a sample.

    >>> from qnerf.quantum.circuit import ANSATZE
    >>> [is_quick(ANSATZE.build("qiren", *size)) for size in ((8, 1), (4, 2), (8, 2), (12, 1))]
    [True, True, False, False]
    """
    seconds = SECONDS * sum(len(gate.wires) + 1 for gate in circuit.gates) * 4.0**circuit.wires
    try:
        return len(interpolation(cones_of_outputs(unmerged(circuit))).points) * seconds <= QUICK_GRID
    except TooLarge:
        return seconds <= QUICK_SAMPLE


@torch.no_grad()
def _evaluate_directly(circuit: Circuit, x: Tensor, weights: Tensor, noise: Noise) -> Tensor:
    n = circuit.wires
    memory.require(f"a density matrix of {n} wires", (2 + circuit.outputs) * 16 * 4.0**n, hint="choose method=sampled")
    gates = circuit.gates
    moving = [k for k, gate in enumerate(gates) if any(Expression.of(angle).features for angle in gate.angles)]
    first, last = (moving[0], moving[-1] + 1) if moving else (0, 0)
    sizes = {len(gate.wires) for gate in gates}
    noises = {size: [_superoperator(operators) for operators in noise.kraus_operators(size)] for size in sizes}

    def channels(part: Sequence[Gate], inputs: Tensor) -> "list[Channel]":
        return [channel for gate in part for channel in _channels_of(gate, circuit, inputs, weights, noises)]

    def run(matrix: Tensor, part: Sequence[Gate], inputs: Tensor) -> Tensor:
        return reduce(lambda m, channel: channel(m, False), channels(part, inputs), matrix)

    observables = torch.stack([m for o in circuit.observables for m in _matrices(o, n)], -1)
    for channel in reversed(channels(gates[last:], x[:1])):
        observables = channel(observables, True)
    measured = observables.transpose(0, 1).reshape(4**n, -1)
    plain = PlainCircuit(circuit)
    fixed = None if plain.program.start_moves else run(_start(plain, x[:1], weights), gates[:first], x[:1])
    out = []
    for part in x.split(max(1, CHUNK_BYTES // (16 * 4**n))):
        start = run(_start(plain, part, weights), gates[:first], part[:1]) if fixed is None else fixed
        rho = run(start, gates[first:last], part)
        out.append((rho.reshape(4**n, -1).T @ measured).real.expand(len(part), -1))
    return torch.cat(out)


def _start(plain: PlainCircuit, x: Tensor, weights: Tensor) -> Tensor:
    """(2^n, 2^n, 1 or B)."""
    state = plain.start(x, weights)
    if state is None:
        state = torch.zeros(1, 2**plain.circuit.wires, dtype=torch.complex128)
        state[0, 0] = 1
    return torch.einsum("Ba,Bb->abB", state, state.conj())


Channel = Callable[[Tensor, bool], Tensor]
"""A map of matrices (2^n, 2^n, B); with True its adjoint, which acts on observables."""


def _channels_of(
    gate: Gate, circuit: Circuit, x: Tensor, weights: Tensor, noises: dict[int, list[Tensor]]
) -> list[Channel]:
    """The gate and the noise after it, in the order in which they act on a state."""
    n, channels = circuit.wires, list[Channel]()

    def add(superoperator: Tensor, wire: int) -> None:
        channels.append(lambda matrix, adjoint: _apply(matrix, superoperator, wire, n, adjoint))

    def add_rotation(word: Word, angle: Tensor) -> None:
        channels.append(lambda matrix, adjoint: _turn(matrix, word, -angle if adjoint else angle, n))

    if gate.name in ("CZ", "CNOT"):  # their own adjoints
        channels.append(lambda matrix, _: _entangle(matrix, gate.name, (gate.wires[0], gate.wires[1]), n))
    else:
        expressions = [gate.angle_of(part) for part in gate.rotations]
        fixed = not any(expression.features for expression in expressions)
        angles = ExpressionTable(expressions, circuit.parameters, fixed)(x, weights).T
        if len(gate.wires) == 1:
            turns = [_rotation(part.letters, angle) for part, angle in zip(gate.rotations, angles, strict=True)]
            unitary = reduce(lambda before, turn: turn @ before, turns)
            add(_superoperator([unitary[0] if fixed else unitary]), gate.wires[0])
        else:
            for part, angle in zip(gate.rotations, angles, strict=True):
                add_rotation(Word.of(part.letters, gate.wires, n), angle)
    for wire in gate.wires:
        for superoperator in noises[len(gate.wires)]:
            add(superoperator, wire)
    return channels


def _turn(matrix: Tensor, word: Word, angle: Tensor, n: int) -> Tensor:
    """U M U^dagger of matrices (2^n, 2^n, B), where U is the rotation about `word` by `angle` (1 or B,)."""
    index, phases = action(word, n, matrix.device, matrix.dtype)
    c, s = (angle / 2).cos(), -1j * (angle / 2).sin()
    matrix = c * matrix + s * (phases[:, None, None] * matrix[index])
    return c * matrix - s * (phases.conj()[None, :, None] * matrix[:, index])


def _rotation(axis: str, angle: Tensor) -> Tensor:
    """exp(-i angle axis / 2): (...) -> (..., 2, 2)."""
    half = (angle / 2).to(torch.complex128)[..., None, None]
    return half.cos() * _PAULIS["I"] - 1j * half.sin() * _PAULIS[axis]


def _superoperator(kraus: list[Tensor]) -> Tensor:
    """S[r, s, u, v] of rho -> sum_K K rho K^dagger, from operators (..., 2, 2): (..., 2, 2, 2, 2)."""
    return torch.stack([torch.einsum("...ru,...sv->...rsuv", k, k.conj()) for k in kraus]).sum(0)


def _apply(matrix: Tensor, superoperator: Tensor, wire: int, n: int, adjoint: bool) -> Tensor:
    """A superoperator (2, 2, 2, 2) or (B, 2, 2, 2, 2), or its adjoint, on one wire of matrices (2^n, 2^n, B)."""
    if adjoint:
        superoperator = superoperator.conj().movedim((-4, -3), (-2, -1))
    before, after = 2**wire, 2 ** (n - wire - 1)
    view = matrix.reshape(before, 2, after, before, 2, after, -1)
    if superoperator.ndim == 4:
        out = torch.einsum("rsuv,aucdvfB->arcdsfB", superoperator, view)
    else:
        view = view.expand(*view.shape[:-1], superoperator.shape[0])
        out = torch.einsum("Brsuv,aucdvfB->arcdsfB", superoperator, view)
    return out.reshape(2**n, 2**n, -1)


def _entangle(matrix: Tensor, gate: str, pair: tuple[int, int], n: int) -> Tensor:
    bits = bit(pair[0], n), bit(pair[1], n)
    if gate == "CZ":
        sign = torch.from_numpy(cz_signs((bits,), n))
        return matrix * (sign[:, None] * sign[None, :])[..., None]
    index = torch.from_numpy(cnot_permutation((bits,), n))
    return matrix[index][:, index]


def _matrices(observable: Observable, n: int) -> list[Tensor]:
    """The matrices (2^n, 2^n) whose expectation values are the outputs of an observable."""
    if isinstance(observable, Probabilities):
        basis, outcome = torch.arange(2**n), torch.zeros(2**n, dtype=torch.int64)
        for wire in observable.wires:
            outcome = 2 * outcome + (basis >> (n - 1 - wire) & 1)
        return [torch.diag((outcome == k).to(torch.complex128)) for k in range(2 ** len(observable.wires))]
    sums = as_sum(observable)
    letters = [[dict(word).get(wire, "I") for wire in range(n)] for word in sums.words]
    words = [reduce(torch.kron, [_PAULIS[letter] for letter in word]) for word in letters]
    return [sum((c * word for c, word in zip(sums.coefficients, words, strict=True)), torch.zeros_like(words[0]))]
