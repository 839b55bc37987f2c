"""Exact noisy expectation values by density matrices, in plain PyTorch (complex128).

The states (2^n, 2^n, B) run forward to the last encoding, B = 1 before the first one; the observables are pulled back
to the same place by the adjoint channels, once for all samples. What does not depend on the input is thus done once.
Noise does not widen light cones: with S = 1 it is enough to do this on the interpolation grid.
"""

from collections.abc import Callable
from math import sqrt

import torch
from torch import Tensor

from qnerf.quantum.circuit import Circuit, Encoding, Entangler, Operation, Rotations
from qnerf.quantum.lightcone import interpolation, polynomials
from qnerf.quantum.normal_form import signs
from qnerf.quantum.pennylane import Noise

CHUNK_BYTES = 2**27

_PAULIS = {
    "X": torch.tensor([[0, 1], [1, 0]], dtype=torch.complex128),
    "Y": torch.tensor([[0, -1j], [1j, 0]], dtype=torch.complex128),
    "Z": torch.tensor([[1, 0], [0, -1]], dtype=torch.complex128),
}


def kraus(noise: Noise) -> list[list[Tensor]]:
    """Kraus operators (2, 2) of each channel, in the order in which they follow a gate."""
    one = torch.eye(2, dtype=torch.complex128)
    raised = torch.tensor([[0, 1], [0, 0]], dtype=torch.complex128)
    channels = []
    if p := noise.depolarizing:
        channels.append([sqrt(1 - p) * one, *(sqrt(p / 3) * pauli for pauli in _PAULIS.values())])
    if p := noise.amplitude_damping:
        channels.append([torch.diag(torch.tensor([1, sqrt(1 - p)], dtype=torch.complex128)), sqrt(p) * raised])
    if p := noise.phase_damping:
        loses = torch.diag(torch.tensor([0, sqrt(p)], dtype=torch.complex128))
        channels.append([torch.diag(torch.tensor([1, sqrt(1 - p)], dtype=torch.complex128)), loses])
    if p := noise.bit_flip:
        channels.append([sqrt(1 - p) * one, sqrt(p) * _PAULIS["X"]])
    return channels


def _rotation(axis: str, angle: Tensor) -> Tensor:
    """exp(-i angle axis / 2): (...) -> (..., 2, 2)."""
    half = (angle / 2).to(torch.complex128)[..., None, None]
    return half.cos() * torch.eye(2, dtype=torch.complex128) - 1j * half.sin() * _PAULIS[axis]


def _superoperator(operators: list[Tensor], adjoint: bool) -> Tensor:
    """sum_K K rho K^dagger as (..., 2, 2, 2, 2), or its adjoint."""
    if adjoint:
        operators = [operator.mH for operator in operators]
    return torch.stack([torch.einsum("...ru,...sv->...rsuv", k, k.conj()) for k in operators]).sum(0)


def _apply(matrix: Tensor, superoperator: Tensor, wire: int, n: int) -> Tensor:
    """On (2^n, 2^n, B); the superoperator is (2, 2, 2, 2), or (B, 2, 2, 2, 2)."""
    before, after = 2**wire, 2 ** (n - wire - 1)
    view = matrix.reshape(before, 2, after, before, 2, after, -1)
    if superoperator.ndim == 4:
        out = torch.einsum("rsuv,aucdvfB->arcdsfB", superoperator, view)
    else:
        view = view.expand(*view.shape[:-1], superoperator.shape[0])
        out = torch.einsum("Brsuv,aucdvfB->arcdsfB", superoperator, view)
    return out.reshape(2**n, 2**n, -1)


def _entangle(matrix: Tensor, gate: str, pair: tuple[int, int], n: int) -> Tensor:
    if gate == "CZ":
        sign = torch.from_numpy(signs((pair,), n))
        return matrix * (sign[:, None] * sign[None, :])[..., None]
    control, target = pair
    index = torch.arange(2**n)
    index = index ^ (((index >> (n - 1 - control)) & 1) << (n - 1 - target))
    return matrix[index][:, index]


def _steps(
    operation: Operation, n: int, x: Tensor, weights: Tensor, channels: list[list[Tensor]], adjoint: bool
) -> list[Callable[[Tensor], Tensor]]:
    """One operation as maps on matrices, in the order in which they are applied (reversed for the adjoint)."""
    steps: list[Callable[[Tensor], Tensor]] = []

    def gate(wire: int, superoperator: Tensor) -> None:
        steps.append(lambda matrix: _apply(matrix, superoperator, wire, n))

    def noise(wire: int) -> None:
        for channel in channels:
            gate(wire, _superoperator(channel, adjoint))

    if isinstance(operation, Entangler):
        for pair in operation.pairs:
            steps.append(lambda matrix, pair=pair: _entangle(matrix, operation.gate, pair, n))  # type: ignore[misc]
            for wire in pair:
                noise(wire)
    else:
        for wire in range(n):
            if isinstance(operation, Rotations):
                phi, theta, omega = weights[operation.row, :, wire]
                unitary = _rotation("Z", omega) @ _rotation("Y", theta) @ _rotation("Z", phi)
            else:
                unitary = _rotation(operation.axis, operation.scales[wire] * x[:, wire])
            gate(wire, _superoperator([unitary], adjoint))
            noise(wire)
    return steps[::-1] if adjoint else steps


def _observables(circuit: Circuit) -> Tensor:
    """(2^n, 2^n, outputs)."""
    n = circuit.wires
    matrices = []
    for word in circuit.observables:
        matrix = torch.eye(1, dtype=torch.complex128)
        letters = dict(word)
        for wire in range(n):
            pauli = _PAULIS[letters[wire]] if wire in letters else torch.eye(2, dtype=torch.complex128)
            matrix = torch.kron(matrix, pauli)
        matrices.append(matrix)
    return torch.stack(matrices, -1)


def evaluate(circuit: Circuit, x: Tensor, weights: Tensor, noise: Noise, tables: dict[bytes, Tensor]) -> Tensor:
    """Noisy expectation values (B, outputs) for x (B, n) and stacked weights (rows, 3, n), no gradients.

    `tables` remembers the polynomials of circuits with small light cones, so that only the first batch pays for them.
    """
    x64, w64 = x.detach().double().cpu(), weights.detach().double().cpu()
    try:
        grid = interpolation(circuit)
    except ValueError:
        return _direct(circuit, x64, w64, noise).to(x)
    key = repr((circuit, noise)).encode() + w64.contiguous().numpy().tobytes()
    if key not in tables:
        if len(grid.points) >= x.shape[0]:
            return _direct(circuit, x64, w64, noise).to(x)
        values = _direct(circuit, torch.from_numpy(grid.points), w64, noise)
        tables[key] = torch.einsum("kcp,pk->kc", torch.from_numpy(grid.matrix), values)
    return polynomials(circuit, x.detach(), tables[key].to(x))


@torch.no_grad()
def _direct(circuit: Circuit, x: Tensor, weights: Tensor, noise: Noise) -> Tensor:
    n, channels = circuit.wires, kraus(noise)
    encodings = [i for i, operation in enumerate(circuit.operations) if isinstance(operation, Encoding)]
    meeting = encodings[-1] + 1 if encodings else 0
    pulled = _observables(circuit)
    for operation in reversed(circuit.operations[meeting:]):
        for step in _steps(operation, n, x, weights, channels, True):
            pulled = step(pulled)
    flat = pulled.transpose(0, 1).reshape(4**n, -1)
    first = encodings[0] if encodings else 0
    start = torch.zeros(2**n, 2**n, 1, dtype=torch.complex128)
    start[0, 0] = 1
    for operation in circuit.operations[:first]:
        for step in _steps(operation, n, x, weights, channels, False):
            start = step(start)
    size = max(1, CHUNK_BYTES // (16 * 4**n))
    out = []
    for part in x.split(size):
        rho = start
        for operation in circuit.operations[first:meeting]:
            for step in _steps(operation, n, part, weights, channels, False):
                rho = step(rho)
        out.append((rho.reshape(4**n, -1).T @ flat).real.expand(len(part), -1))
    return torch.cat(out)
