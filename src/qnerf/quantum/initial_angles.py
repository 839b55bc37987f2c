"""Starting values of the trainable angles, (rows, n, 3) in radians. All draw from torch's global generator."""

from math import pi

import torch
from torch import Tensor

from qnerf.config.registry import Registry
from qnerf.quantum.circuit import Circuit

INITS: Registry[Tensor] = Registry("init")


@INITS.register("uniform")
def uniform(circuit: Circuit) -> Tensor:
    """Every angle uniform in [0, 2 pi], as published."""
    return torch.rand(circuit.rows, circuit.wires, 3) * (2 * pi)


@INITS.register("eighth")
def eighth(circuit: Circuit) -> Tensor:
    """theta = pi/8 + 0.1 N(0, 1); phi and omega pi/4 N(0, 1).

    The outputs of 8 wires then have a standard deviation of 0.10, 0.16, 0.17 and 0.17 over standard normal inputs
    (S = 1, 2, 3, 4), where `uniform` gives 0.06. Other spreads were tried, with theta around pi/8, pi/6 and pi/4; none
    gives more at S = 1 and 2.
    """
    angles = torch.randn(circuit.rows, circuit.wires, 3) * torch.tensor([pi / 4, 0.1, pi / 4])
    angles[..., 1] += pi / 8
    return angles
