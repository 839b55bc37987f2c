"""Starting angles of the trainable rotations. All draw from torch's global generator."""

from math import pi

import torch
from torch import Tensor

from qnerf.config.registry import Registry
from qnerf.quantum.circuit import Circuit

INITS: Registry[Tensor] = Registry("init")


@INITS.register("uniform")
def uniform(circuit: Circuit) -> Tensor:
    """U[0, 2 pi] for every angle (rows, n, 3), as published."""
    return torch.rand(circuit.rows, circuit.wires, 3) * (2 * pi)


@INITS.register("eighth")
def eighth(circuit: Circuit) -> Tensor:
    """theta = pi/8 + 0.1 N(0, 1); phi, omega = pi/4 N(0, 1): (rows, n, 3).

    Outputs over standard normal inputs then vary by 0.10, 0.16, 0.17, 0.17 (S = 1, 2, 3, 4; 8 wires), where `uniform`
    gives 0.06: of the spreads tried (theta near pi/8, pi/6, pi/4; 0 to 0.3 and 0 to pi/4) none gives more at S = 1
    and 2.
    """
    angles = torch.randn(circuit.rows, circuit.wires, 3) * torch.tensor([pi / 4, 0.1, pi / 4])
    angles[..., 1] += pi / 8
    return angles
