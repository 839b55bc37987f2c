"""Starting values of the trainable weights of a circuit, (P,) in radians. All draw from torch's global generator."""

from math import pi

import torch
from torch import Tensor

from qnerf.config.registry import Registry
from qnerf.quantum.angles import offsets
from qnerf.quantum.circuit import Circuit

INITS: Registry[Tensor] = Registry("init")


@INITS.register("uniform")
def uniform(circuit: Circuit) -> Tensor:
    """Every angle uniform in [0, 2 pi], as published."""
    return torch.rand(circuit.size) * (2 * pi)


@INITS.register("eighth")
def eighth(circuit: Circuit) -> Tensor:
    """Angles of rotations about Z, such as phi and omega, are pi/4 N(0, 1), all others pi/8 + 0.1 N(0, 1).

    The outputs of QIREN on 8 wires then have a standard deviation of 0.10, 0.16, 0.17 and 0.17 over standard normal
    inputs (S = 1, 2, 3, 4), where `uniform` gives 0.06. Other spreads were tried, with theta around pi/8, pi/6 and
    pi/4; none gives more at S = 1 and 2.
    """
    phases = torch.ones(circuit.size, dtype=torch.bool)
    first = offsets(circuit.parameters)
    for gate in circuit.gates:
        for part in gate.rotations:
            if set(part.letters) - set("IZ"):
                phases[[first[name] + index for name, index in gate.angle_of(part).weights]] = False
    drawn = torch.randn(circuit.size)
    return torch.where(phases, drawn * (pi / 4), drawn * 0.1 + pi / 8)
