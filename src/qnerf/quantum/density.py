"""Exact expectation values of noisy circuits by density matrices, in plain PyTorch (complex128).

The density matrices (2^n, 2^n, B) run forward to the last encoding, with B = 1 up to the first one. The observables
are carried back to the same place by the adjoint channels, once for all samples. What does not depend on the input is
thus computed once. Noise does not widen light cones, so with S = 1 the interpolation grid is enough.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from qnerf.config import memory
from qnerf.quantum.circuit import Circuit, Encoding, Entangler, Operation, Rotations
from qnerf.quantum.cones import TooLarge
from qnerf.quantum.lightcone import coefficients_of, interpolation, polynomials
from qnerf.quantum.noise import Noise
from qnerf.quantum.normal_form import cnot_permutation, cz_signs

CHUNK_BYTES = 2**27
SECONDS = 3e-7  # for each wire and entry of a density matrix, one core; within a factor of 3 at 4 to 8 wires
QUICK_GRID, QUICK_SAMPLE = 60.0, 1e-3  # seconds

_PAULIS = {
    "I": torch.eye(2, dtype=torch.complex128),
    "X": torch.tensor([[0, 1], [1, 0]], dtype=torch.complex128),
    "Y": torch.tensor([[0, -1j], [1j, 0]], dtype=torch.complex128),
    "Z": torch.tensor([[1, 0], [0, -1]], dtype=torch.complex128),
}


def evaluate(circuit: Circuit, x: Tensor, weights: Tensor, noise: Noise, cache: dict[bytes, Tensor]) -> Tensor:
    """Noisy expectation values (B, outputs) for x (B, n) and stacked weights (rows, 3, n), without gradients.

    `cache` takes the coefficients of circuits with small light cones, so that only the first batch pays for them.
    """
    x64, w64 = x.detach().double().cpu(), weights.detach().double().cpu()
    try:
        grid = interpolation(circuit)
    except TooLarge:
        return _evaluate_directly(circuit, x64, w64, noise).to(x)
    key = repr((circuit, noise)).encode() + w64.contiguous().numpy().tobytes()
    if key not in cache:
        if len(grid.points) >= x.shape[0]:
            return _evaluate_directly(circuit, x64, w64, noise).to(x)
        cache[key] = coefficients_of(grid, _evaluate_directly(circuit, torch.from_numpy(grid.points), w64, noise))
    return polynomials(circuit, x.detach(), cache[key].to(x))


def is_quick(circuit: Circuit) -> bool:
    """Whether it takes at most a minute once, for circuits with small light cones, or a millisecond a sample.

    >>> from qnerf.quantum.circuit import ANSATZE
    >>> [is_quick(ANSATZE.build("qiren", *size)) for size in ((8, 1), (4, 2), (8, 2), (12, 1))]
    [True, True, False, False]
    """
    seconds = SECONDS * circuit.wires * 4.0**circuit.wires
    try:
        return len(interpolation(circuit).points) * seconds <= QUICK_GRID
    except TooLarge:
        return seconds <= QUICK_SAMPLE


@torch.no_grad()
def _evaluate_directly(circuit: Circuit, x: Tensor, weights: Tensor, noise: Noise) -> Tensor:
    n = circuit.wires
    memory.require(f"a density matrix of {n} wires", 2 * 16 * 4.0**n, hint="choose method=sampled")
    channels = {size: [_superoperator(operators) for operators in noise.kraus_operators(size)] for size in (1, 2)}
    encodings = [i for i, operation in enumerate(circuit.operations) if isinstance(operation, Encoding)]
    first, last = (encodings[0], encodings[-1] + 1) if encodings else (0, 0)

    def run(matrix: Tensor, operations: tuple[Operation, ...], inputs: Tensor) -> Tensor:
        for operation in operations:
            for channel in _channels_of(operation, n, inputs, weights, channels):
                matrix = channel(matrix, False)
        return matrix

    observables = _observables(circuit)
    for operation in reversed(circuit.operations[last:]):
        for channel in reversed(_channels_of(operation, n, x, weights, channels)):
            observables = channel(observables, True)
    flat = observables.transpose(0, 1).reshape(4**n, -1)
    start = torch.zeros(2**n, 2**n, 1, dtype=torch.complex128)
    start[0, 0] = 1
    start = run(start, circuit.operations[:first], x)
    out = []
    for part in x.split(max(1, CHUNK_BYTES // (16 * 4**n))):
        rho = run(start, circuit.operations[first:last], part)
        out.append((rho.reshape(4**n, -1).T @ flat).real.expand(len(part), -1))
    return torch.cat(out)


Channel = Callable[[Tensor, bool], Tensor]
"""A map of matrices (2^n, 2^n, B); with True its adjoint, which acts on observables."""


def _channels_of(
    operation: Operation, n: int, x: Tensor, weights: Tensor, noise: dict[int, list[Tensor]]
) -> list[Channel]:
    """The gates of one operation and the noise after each, in the order in which they act on a state."""
    channels: list[Channel] = []

    def add(superoperator: Tensor, wire: int) -> None:
        channels.append(lambda matrix, adjoint: _apply(matrix, superoperator, wire, n, adjoint))

    def add_noise(*wires: int) -> None:
        for wire in wires:
            for superoperator in noise[len(wires)]:
                add(superoperator, wire)

    if isinstance(operation, Entangler):
        for pair in operation.pairs:
            # CZ and CNOT are their own adjoints.
            channels.append(lambda matrix, adjoint, pair=pair: _entangle(matrix, operation.gate, pair, n))  # type: ignore[misc]
            add_noise(*pair)
    else:
        for wire in range(n):
            if isinstance(operation, Rotations):
                phi, theta, omega = weights[operation.row, :, wire]
                unitary = _rotation("Z", omega) @ _rotation("Y", theta) @ _rotation("Z", phi)
            else:
                assert isinstance(operation, Encoding), "a data re-uploading circuit"
                unitary = _rotation(operation.axis, operation.scales[wire] * x[:, wire])
            add(_superoperator([unitary]), wire)
            add_noise(wire)
    return channels


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
    if gate == "CZ":
        sign = torch.from_numpy(cz_signs((pair,), n))
        return matrix * (sign[:, None] * sign[None, :])[..., None]
    index = torch.from_numpy(cnot_permutation((pair,), n))
    return matrix[index][:, index]


def _observables(circuit: Circuit) -> Tensor:
    """The matrices of the measured Pauli words, (2^n, 2^n, outputs)."""
    matrices = []
    for word in circuit.words:
        matrix = torch.eye(1, dtype=torch.complex128)
        for wire in range(circuit.wires):
            matrix = torch.kron(matrix, _PAULIS[dict(word).get(wire, "I")])
        matrices.append(matrix)
    return torch.stack(matrices, -1)
