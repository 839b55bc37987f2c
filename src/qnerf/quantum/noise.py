"""What a device does wrong: errors of gates, relaxation, errors of the readout."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import exp, prod, sqrt
from typing import Any, Literal

import torch
from torch import Tensor

from qnerf.config.checks import is_number

CHANNELS = {
    "depolarizing": "DepolarizingChannel",
    "amplitude_damping": "AmplitudeDamping",
    "phase_damping": "PhaseDamping",
    "bit_flip": "BitFlip",
}
"""Field of `Noise` -> PennyLane's channel, in the order in which they follow a gate."""

Field = Literal[
    "depolarizing", "amplitude_damping", "phase_damping", "bit_flip", "two_qubit", "readout",
    "t1", "t2", "one_qubit_time", "two_qubit_time",
]  # fmt: skip
TIMES = ("t1", "t2", "one_qubit_time", "two_qubit_time")


@dataclass(frozen=True)
class Noise:
    """Channels after every gate, on each wire that the gate touches, and errors of the readout.

    Args:
        depolarizing, amplitude_damping, phase_damping, bit_flip: probabilities in [0, 1], as PennyLane defines them.
        two_qubit: probability of the depolarizing channel after gates on two or more wires; None for `depolarizing`.
        readout: probability that a wire is read wrongly.
        t1, t2: relaxation and dephasing times, seconds; t2 <= 2 t1. None: no relaxation, no dephasing beyond it.
        one_qubit_time, two_qubit_time: duration of a gate, seconds. Wires relax during their own gates; those that
            wait for others do not.

    >>> Noise(depolarizing=0.01, bit_flip=0.002).after(1)
    [('DepolarizingChannel', 0.01), ('BitFlip', 0.002)]
    >>> Noise(depolarizing=0.001, two_qubit=0.01).after(2)
    [('DepolarizingChannel', 0.01)]

    Raises:
        ValueError: a probability outside [0, 1], a negative time, t2 > 2 t1, or relaxation without times of gates.
    """

    depolarizing: float = 0.0
    amplitude_damping: float = 0.0
    phase_damping: float = 0.0
    bit_flip: float = 0.0
    two_qubit: float | None = None
    readout: float = 0.0
    t1: float | None = None
    t2: float | None = None
    one_qubit_time: float = 0.0
    two_qubit_time: float = 0.0

    def __post_init__(self) -> None:
        for name in (*CHANNELS, "readout"):
            _check_probability(name, getattr(self, name))
        if self.two_qubit is not None:
            _check_probability("two_qubit", self.two_qubit)
        for name in TIMES:
            value = getattr(self, name)
            if value is not None and not (is_number(value) and value >= 0):
                raise ValueError(f"noise: {name} expects a time in seconds, got {value!r}")
        if 0 in (self.t1, self.t2):
            raise ValueError("noise: t1 and t2 expect a time above 0; leave one out for no relaxation")
        if self.t1 is not None and self.t2 is not None and self.t2 > 2 * self.t1:
            raise ValueError(f"noise: t2 expects at most 2 t1 = {2 * self.t1:g}, got {self.t2:g}")
        if (self.t1 or self.t2) and not (self.one_qubit_time or self.two_qubit_time):
            raise ValueError("noise: t1 and t2 also expect one_qubit_time and two_qubit_time, seconds")

    @classmethod
    def of(cls, value: Any) -> "Noise | None":
        """From a `Noise`, a mapping of its fields, a number (a depolarizing probability) or None.

        >>> Noise.of({"two_qubit": 0.01}) == Noise(two_qubit=0.01), Noise.of(0.1) == Noise(depolarizing=0.1)
        (True, True)
        """
        if value is None or isinstance(value, cls):
            return value
        if is_number(value):
            return cls(depolarizing=value)
        if not isinstance(value, Mapping):
            raise ValueError(f"noise expects a Noise, its fields, a depolarizing probability or None, got {value!r}")
        known = [field.name for field in fields(cls)]
        for name in value:
            if name not in known:
                raise ValueError(f"noise: unknown field {name!r}; known: {', '.join(known)}")
        return cls(**value)

    @property
    def any(self) -> bool:
        """Whether anything goes wrong at all."""
        return bool(self.gates or self.readout)

    @property
    def gates(self) -> bool:
        """Whether any gate has an error."""
        return bool(self.after(1) or self.after(2))

    def after(self, wires: int) -> list[tuple[str, float]]:
        """PennyLane's name and the parameter of each channel on each wire of a gate on that many wires.

        Thermal relaxation for a time t is amplitude damping by 1 - exp(-t / T1) and phase damping by
        1 - exp(-2 t (1 / T2 - 1 / (2 T1))): populations decay with T1, coherences with T2.
        """
        named = {name: vars(self)[name] for name in CHANNELS}
        if wires > 1 and self.two_qubit is not None:
            named["depolarizing"] = self.two_qubit
        found = [(CHANNELS[name], probability) for name, probability in named.items()]
        time = self.one_qubit_time if wires == 1 else self.two_qubit_time
        relaxation = 1 / self.t1 if self.t1 else 0.0
        dephasing = max(1 / self.t2 - relaxation / 2, 0.0) if self.t2 else 0.0
        found.append(("AmplitudeDamping", 1 - exp(-time * relaxation)))
        found.append(("PhaseDamping", 1 - exp(-2 * time * dephasing)))
        return [(name, probability) for name, probability in found if probability]

    def kraus_operators(self, wires: int) -> list[list[Tensor]]:
        """The Kraus operators (2, 2), complex128, of each channel `after` a gate."""
        import pennylane as qml

        return [
            [torch.from_numpy(k).to(torch.complex128) for k in getattr(qml, name).compute_kraus_matrices(p)]
            for name, p in self.after(wires)
        ]

    def pauli_probabilities(self, wires: int) -> tuple[float, float, float]:
        """Probabilities of X, Y and Z on a wire of a gate, all its channels together.

        Amplitude damping is not a mixture of Pauli errors. Its Pauli twirl takes its place: the channel averaged over
        conjugation with all Paulis, which keeps the diagonal of its transfer matrix (arXiv:1305.2021).
        """
        factors = [_pauli_factors(name, probability) for name, probability in self.after(wires)]
        x, y, z = (prod(each[letter] for each in factors) for letter in range(3))
        return (1 + x - y - z) / 4, (1 - x + y - z) / 4, (1 - x - y + z) / 4


def _check_probability(name: str, value: Any) -> None:
    if not is_number(value) or not 0 <= value <= 1:
        raise ValueError(f"noise: {name} expects a probability in [0, 1], got {value!r}")


def _pauli_factors(channel: str, p: float) -> tuple[float, float, float]:
    """What is left of the expectation values of X, Y and Z on a wire after a channel (the diagonal of its matrix)."""
    if channel == "DepolarizingChannel":
        return (1 - 4 * p / 3,) * 3
    if channel == "BitFlip":
        return 1.0, 1 - 2 * p, 1 - 2 * p
    return sqrt(1 - p), sqrt(1 - p), (1 - p if channel == "AmplitudeDamping" else 1.0)
