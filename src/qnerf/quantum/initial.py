"""Starting angles of the trainable rotations. All draw from torch's global generator."""

from math import pi

import torch
from torch import Tensor

from qnerf.quantum.circuit import Circuit
from qnerf.registry import Registry

INITS: Registry[Tensor] = Registry("init")


@INITS.register("uniform")
def uniform(circuit: Circuit) -> Tensor:
    """U[0, 2 pi] for every angle (rows, n, 3), as published."""
    return torch.rand(circuit.rows, circuit.wires, 3) * (2 * pi)


@INITS.register("eighth")
def eighth(circuit: Circuit) -> Tensor:
    """theta near pi/8, phi and omega near 0 (rows, n, 3)."""
    angles = 0.1 * torch.randn(circuit.rows, circuit.wires, 3)
    angles[..., 1] += pi / 8
    return angles
