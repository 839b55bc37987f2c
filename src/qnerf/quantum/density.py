"""Exact outputs of noisy circuits by density matrices, in plain PyTorch (complex128).

The density matrices (2^n, 2^n, B) run forward to the last gate that takes a feature, with B = 1 up to the first one.
The observables are carried back to the same place by the adjoint channels, once for all samples. What does not depend
on the input is thus computed once. Noise does not widen the light cones of gates that are not merged, so circuits with
small cones need the interpolation grid alone.
"""

from collections.abc import Callable, Sequence
from functools import partial, reduce

import torch
from torch import Tensor

from qnerf.config import memory
from qnerf.quantum.angles import ExpressionTable
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
    """The gate, rotation by rotation, and the noise after it, in the order in which they act on a state."""
    n, expressions = circuit.wires, [gate.angle_of(part) for part in gate.rotations]
    fixed = not any(expression.features for expression in expressions)
    angles = ExpressionTable(expressions, circuit.parameters, fixed)(x, weights).T
    words = [Word.of(part.letters, gate.wires, n) for part in gate.rotations]
    turns = (partial(_turn, word, angle, n) for word, angle in zip(words, angles, strict=True))
    noise = (partial(_apply, own, wire, n) for wire in gate.wires for own in noises[len(gate.wires)])
    return [*turns, *noise]


def _turn(word: Word, angle: Tensor, n: int, matrix: Tensor, adjoint: bool) -> Tensor:
    """U M U^dagger of matrices (2^n, 2^n, B), where U is the rotation about `word` by `angle` (1 or B,)."""
    index, phases = action(word, n, matrix.device, matrix.dtype)
    c, s = (angle / 2).cos(), 1j * (angle / 2).sin() * (1 if adjoint else -1)
    matrix = c * matrix + s * (phases[:, None, None] * matrix[index])
    return c * matrix - s * (phases.conj()[None, :, None] * matrix[:, index])


def _superoperator(kraus: list[Tensor]) -> Tensor:
    """S[r, s, u, v] of rho -> sum_K K rho K^dagger, from operators (2, 2): (2, 2, 2, 2)."""
    return torch.stack([torch.einsum("ru,sv->rsuv", k, k.conj()) for k in kraus]).sum(0)


def _apply(superoperator: Tensor, wire: int, n: int, matrix: Tensor, adjoint: bool) -> Tensor:
    """A superoperator (2, 2, 2, 2), or its adjoint, on one wire of matrices (2^n, 2^n, B)."""
    if adjoint:
        superoperator = superoperator.conj().movedim((-4, -3), (-2, -1))
    before, after = 2**wire, 2 ** (n - wire - 1)
    view = matrix.reshape(before, 2, after, before, 2, after, -1)
    return torch.einsum("rsuv,aucdvfB->arcdsfB", superoperator, view).reshape(2**n, 2**n, -1)


def _matrices(observable: Observable, n: int) -> list[Tensor]:
    """The matrices (2^n, 2^n) whose expectation values are the outputs of an observable."""
    if isinstance(observable, Probabilities):
        basis, outcome = torch.arange(2**n), torch.zeros(2**n, dtype=torch.int64)
        for wire in observable.wires:
            outcome = 2 * outcome + (basis >> (n - 1 - wire) & 1)
        return [torch.diag((outcome == k).to(torch.complex128)) for k in range(2 ** len(observable.wires))]
    sums = as_sum(observable)
    total = torch.zeros(2**n, 2**n, dtype=torch.complex128)
    for coefficient, word in zip(sums.coefficients, sums.words, strict=True):
        own = Word.of([letter for _, letter in word], [wire for wire, _ in word], n)
        index, phases = action(own, n, total.device, total.dtype)
        total[torch.arange(2**n), index] += coefficient * phases
    return [total]
