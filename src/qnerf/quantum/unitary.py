"""The matrix of a circuit that holds no data. A step builds it once, for all samples.

It is plain PyTorch, for any device, with derivatives of any order. PennyLane is its reference.
"""

import torch
from torch import Tensor

from qnerf.quantum.circuit import Circuit, Encoding, Entangler, Operation, Rotations, ring
from qnerf.quantum.normal_form import cnot_permutation, cz_signs
from qnerf.quantum.statevector import table


def layered(wires: int, layers: int, *, uploads: int = 0, entangler: str = "CZ", entangled: bool = True) -> Circuit:
    """Blocks of `layers` rotations on every wire, each followed by a ring; between the blocks RZ encodings.

    uploads: encodings; the circuit has uploads + 1 blocks. entangled=False: without the rings. Rows are numbered block
    by block.

    >>> layered(2, 1).operations[1]
    Entangler(gate='CZ', pairs=((0, 1),))
    """
    pairs = ring(wires, 1)[: 1 if wires == 2 else None] if entangled else ()  # two wires: CZ twice would cancel
    operations: list[Operation] = []
    for block in range(uploads + 1):
        for layer in range(layers):
            operations += [Rotations(block * layers + layer), Entangler(entangler, pairs)]
        if block < uploads:
            operations.append(Encoding("Z", (1.0,) * wires))
    observables = tuple(((wire, "Z"),) for wire in range(wires))
    return Circuit("layered", wires, max(uploads, 1), layers, tuple(operations), observables)


def rotation(angles: Tensor) -> Tensor:
    """Rot(phi, theta, omega) = RZ(omega) RY(theta) RZ(phi) for angles (..., 3) in radians: complex (..., 2, 2).

    Angles (..., 1) are theta alone, and the matrices are real.
    """
    theta = angles[..., angles.shape[-1] // 2] / 2
    c, s = theta.cos(), theta.sin()
    matrix = torch.stack([c, -s, s, c], -1).unflatten(-1, (2, 2))
    if angles.shape[-1] == 1:
        return matrix
    half = angles[..., ::2] / 2  # phi and omega
    before, after = (torch.polar(torch.ones_like(part), -part) for part in half.unbind(-1))
    columns, rows = (torch.stack([phase, phase.conj()], -1) for phase in (before, after))
    return rows[..., :, None] * matrix * columns[..., None, :]


def blocks(circuit: Circuit, angles: Tensor) -> list[Tensor]:
    """The matrices (2^n, 2^n) of the parts of a circuit before, between and after its encodings.

    Args:
        angles: (rows, n, 3) radians of the rotations, or (rows, n, 1): theta alone, real where the circuit has CZ or
            CNOT only, which both are real.

    >>> import math
    >>> blocks(layered(1, 1), torch.full((1, 1, 1), math.pi))[0].round().abs()
    tensor([[0., 1.],
            [1., 0.]])
    """
    single = rotation(angles)
    matrices = single[:, 0]
    for wire in range(1, circuit.wires):
        size = matrices.shape[-1]
        product = matrices[:, :, None, :, None] * single[:, wire, None, :, None, :]
        matrices = product.reshape(-1, 2 * size, 2 * size)
    layers = list(matrices.unbind(0))
    parts: list[Tensor] = []
    unit = torch.eye(2**circuit.wires, dtype=single.dtype, device=single.device)
    whole = unit
    for operation in circuit.operations:
        if isinstance(operation, Encoding):
            parts.append(whole)
            whole = unit
        elif isinstance(operation, Rotations):
            layer = layers[operation.row]
            whole = layer if whole is unit else layer @ whole
        else:
            assert isinstance(operation, Entangler)
            whole = _entangled(whole, operation, circuit.wires)
    return [*parts, whole]


def _entangled(states: Tensor, operation: Entangler, wires: int) -> Tensor:
    """The entangler on states (2^n, ...)."""
    if not operation.pairs:
        return states
    if operation.gate == "CZ":
        return table(cz_signs, operation.pairs, wires, states.device, states.real.dtype)[:, None] * states
    return states[table(cnot_permutation, operation.pairs, wires, states.device, None)]
