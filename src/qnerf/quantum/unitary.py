"""The matrix of a circuit that holds no data. A step builds it once, for all samples.

It is plain PyTorch, for any device, with derivatives of any order. PennyLane is its reference.
"""

import torch
from torch import Tensor

from qnerf.quantum.basis import bit, cz_signs
from qnerf.quantum.circuit import Circuit, Gate, encoding, entanglers, ring, rotations
from qnerf.quantum.expressions import Weights
from qnerf.quantum.statevector import table


def pairs_of(wires: int, entangled: bool = True) -> tuple[tuple[int, int], ...]:
    """The pairs of a ring; none if not `entangled`. Two wires have one pair: CZ twice would cancel."""
    return ring(wires, 1)[: 1 if wires == 2 else None] if entangled else ()


def layered(wires: int, layers: int, *, uploads: int = 0, entangled: bool = True) -> Circuit:
    """Blocks of `layers` rotations on every wire, each followed by a ring of CZ; between the blocks RZ encodings.

    uploads: encodings; the circuit has uploads + 1 blocks. entangled=False: without the rings. Its weights `angles` are
    (rows, n, 3), block by block.

    >>> layered(2, 1).operations[2]
    Gate(name='CZ', wires=(0, 1), angles=(), word='')
    """
    angles = Weights("angles", ((uploads + 1) * layers, wires, 3))
    operations: list[Gate] = []
    for row in range(angles.shape[0]):
        if row and row % layers == 0:
            operations += encoding("Z", (1.0,) * wires)
        operations += rotations(angles[row])
        operations += entanglers("CZ", pairs_of(wires, entangled))
    observables = tuple(((wire, "Z"),) for wire in range(wires))
    return Circuit("layered", wires, tuple(operations), observables, weights=(angles,))


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


def blocks(angles: Tensor, layers: int, entangled: bool = True) -> list[Tensor]:
    """The matrices (2^n, 2^n) of the blocks of a `layered` circuit.

    Args:
        angles: (rows, n, 3) radians of the rotations, or (rows, n, 1): theta alone, and the matrices are real.

    >>> import math
    >>> blocks(torch.full((1, 1, 1), math.pi), 1)[0].round().abs()
    tensor([[0., 1.],
            [1., 0.]])
    """
    single, wires = rotation(angles), angles.shape[1]
    matrices = single[:, 0]
    for wire in range(1, wires):
        size = matrices.shape[-1]
        product = matrices[:, :, None, :, None] * single[:, wire, None, :, None, :]
        matrices = product.reshape(-1, 2 * size, 2 * size)
    pairs = tuple((bit(a, wires), bit(b, wires)) for a, b in pairs_of(wires, entangled))
    signs = table(cz_signs, pairs, wires, matrices.device, matrices.real.dtype)[:, None] if pairs else None
    parts: list[Tensor] = []
    for row, layer in enumerate(matrices.unbind(0)):
        turned = layer if row % layers == 0 else layer @ parts.pop()
        parts.append(turned if signs is None else signs * turned)
    return parts
