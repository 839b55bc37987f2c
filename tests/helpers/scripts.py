"""Random QNodes over PennyLane's operations, numbered, as `circuits` has random circuits."""

from collections.abc import Callable
from random import Random
from typing import Any, NamedTuple

import numpy as np
import pennylane as qml
import torch
from torch import Tensor

from qnerf.quantum.gates import GATES
from tests.helpers.circuits import SPECIAL

NUMBERS = 6  # of weights, and of features
UNITARY = np.linalg.qr(np.random.RandomState(0).randn(4, 4))[0]
LABELS = [[0, 1, 2, 3], [1, 0, 3, 2], [1, 2, 0, 3], [7, 2, 11, 5], ["b", "a", "d", "c"], ["q", 0, "r", -1]]


class Axis(qml.operation.Operation):
    """An operation whose decomposition reads an attribute."""

    num_wires, num_params, ndim_params = 1, 1, (0,)

    def __init__(self, x, wires, axis="X", id=None):
        self.axis = axis
        super().__init__(x, wires=wires, id=id)

    def decomposition(self):
        return [(qml.RX if self.axis == "X" else qml.RY)(self.data[0], wires=self.wires)]


class U3(qml.operation.Operation):
    """An operation with the name of a gate, in another convention."""

    num_wires, num_params, ndim_params = 1, 3, (0, 0, 0)

    @staticmethod
    def compute_decomposition(*angles: Any, wires: Any) -> list[Any]:
        return [gate(angle, wires) for gate, angle in zip((qml.RX, qml.RY, qml.RZ), angles, strict=True)]


def _matrix(p):
    return torch.matrix_exp(1j * p[0][..., None, None] * torch.tensor([[0, 1], [1, 0]], dtype=torch.complex128))


OTHERS = {
    "Adjoint": (1, lambda p, w: qml.adjoint(qml.Rot(*p, wires=w[0]))),
    "Adjoint of a Clifford gate": (1, lambda p, w: qml.adjoint(qml.S(w[0]))),
    "Pow": (1, lambda p, w: qml.pow(qml.RX(p[0], wires=w[0]), 2)),
    "Pow of a gate": (1, lambda p, w: qml.pow(qml.SX(w[0]), 3)),
    "Prod": (2, lambda p, w: qml.prod(qml.RX(p[0], wires=w[0]), qml.CRZ(p[1], wires=w[:2]))),
    "Exp": (2, lambda p, w: qml.evolve(qml.Z(w[0]) @ qml.Y(w[1]), 0.3)),
    "Axis": (1, lambda p, w: Axis(p[0], wires=w[0], axis="Y")),
    "the name of a gate": (1, lambda p, w: U3(*p, wires=w[0])),
    "control": (2, lambda p, w: qml.ctrl(qml.RX(p[0], wires=w[1]), control=w[0])),
    "control of zeros": (3, lambda p, w: qml.ctrl(qml.RY(p[0], wires=w[2]), w[:2], control_values=[0, 1])),
    "control of a phase": (3, lambda p, w: qml.ctrl(qml.PhaseShift(p[0], wires=w[0]), control=w[1:3])),
    "control of a control": (3, lambda p, w: qml.ctrl(qml.CRX(p[0], wires=w[:2]), control=w[2])),
    "control of three angles": (2, lambda p, w: qml.ctrl(qml.U3(*p, wires=w[0]), control=w[1])),
    "MultiControlledX": (3, lambda p, w: qml.MultiControlledX(wires=w[:3], control_values=[1, 0])),
    "QubitUnitary of numbers": (2, lambda p, w: qml.QubitUnitary(UNITARY, wires=w[:2])),
    "QubitUnitary, rounded": (2, lambda p, w: qml.QubitUnitary(UNITARY.round(4), wires=w[:2])),
    "QubitUnitary of weights": (1, lambda p, w: qml.QubitUnitary(_matrix(p), wires=w[0])),
    "DiagonalQubitUnitary": (1, lambda p, w: qml.DiagonalQubitUnitary(np.exp([0.2j, -0.4j]), wires=w[0])),
    "SpecialUnitary": (1, lambda p, w: qml.SpecialUnitary(np.array([0.1, 0.2, 0.3]), wires=w[0])),
    "PSWAP": (2, lambda p, w: qml.PSWAP(p[0], wires=w[:2])),
    "ECR": (2, lambda p, w: qml.ECR(wires=w[:2])),
    "FermionicSWAP": (2, lambda p, w: qml.FermionicSWAP(p[0], wires=w[:2])),
    "SingleExcitationPlus": (2, lambda p, w: qml.SingleExcitationPlus(p[0], wires=w[:2])),
    "SingleExcitationMinus": (2, lambda p, w: qml.SingleExcitationMinus(p[0], wires=w[:2])),
    "DoubleExcitationPlus": (4, lambda p, w: qml.DoubleExcitationPlus(p[0], wires=w[:4])),
    "OrbitalRotation": (4, lambda p, w: qml.OrbitalRotation(p[0], wires=w[:4])),
    "PCPhase": (2, lambda p, w: qml.PCPhase(p[0], dim=3, wires=w[:2])),
    "BasisState": (2, lambda p, w: qml.BasisState(np.array([1, 1]), wires=w[:2])),
    "QFT": (3, lambda p, w: qml.QFT(wires=w[:3])),
    "Permute": (3, lambda p, w: qml.Permute([w[2], w[0], w[1]], wires=w[:3])),
    "QubitSum": (3, lambda p, w: qml.QubitSum(wires=w[:3])),
    "QubitCarry": (4, lambda p, w: qml.QubitCarry(wires=w[:4])),
    "Select": (2, lambda p, w: qml.Select([qml.RX(p[0], wires=w[1]), qml.RY(p[1], wires=w[1])], control=w[0])),
    "PrepSelPrep": (2, lambda p, w: qml.PrepSelPrep(qml.dot([0.3, -0.4], [qml.X(w[1]), qml.Z(w[1])]), control=[w[0]])),
    "GlobalPhase": (1, lambda p, w: qml.GlobalPhase(p[0])),
    "Identity": (1, lambda p, w: qml.I(w[0])),
    "Barrier": (1, lambda p, w: qml.Barrier(wires=w)),
    "AngleEmbedding": (2, lambda p, w: qml.AngleEmbedding(torch.stack(p[:2], -1), wires=w[:2], rotation="Y")),
    "IQPEmbedding": (3, lambda p, w: qml.IQPEmbedding(torch.stack(p, -1), wires=w[:3], n_repeats=2)),
}  # fmt: skip
"""Name -> number of wires, and what queues the operation, with numbers that may be one for each sample, on wires."""


FUNCTIONS = [lambda p: p, lambda p: p, torch.sin, torch.square, lambda p: np.pi * p]


class Script(NamedTuple):
    """A function of inputs (..., 6) and of weights `a` (6,), the labels of its wires, and values of `a`."""

    function: Callable[..., Any]
    labels: list[Any]
    weights: Tensor


def random_script(number):
    """1 to 4 wires. The weights are special numbers for half of the scripts."""
    rng = Random(number)
    n = rng.randint(1, 4)
    labels = rng.choice(LABELS)[:n]
    width = {name: kind.wires or 1 for name, kind in GATES.items()} | {name: own[0] for name, own in OTHERS.items()}
    names = [[name for name in own if width[name] <= n] for own in (GATES, GATES, GATES, OTHERS)]
    queued = [_amplitudes(rng, labels)] if rng.random() < 0.3 else []
    wire = rng.choice(labels)
    queued.append(lambda a, x: qml.RY(x[..., 0], wires=wire))  # TorchLayer needs a tensor, and a batch of results
    for _ in range(rng.randint(1, 10)):
        queued.append(_operation(rng, rng.choice(rng.choice(names)), rng.sample(labels, n)))
    scalars = rng.choices(["expval", "var", "hamiltonian"], k=rng.randint(1, 3))
    kinds = rng.choice([["probs"], ["all probabilities"], scalars, scalars])  # TorchLayer stacks results of one shape
    kinds = [rng.choice(["state", "weighted"])] if rng.random() < 0.05 else kinds  # for default.qubit
    measurements = [_measurement(rng, kind, rng.sample(labels, n)) for kind in kinds]
    container = rng.choice([list, tuple])

    def function(inputs, a):
        for queue in queued:
            queue(a, inputs)
        return container(measure(a) for measure in measurements)

    special = rng.random() < 0.5
    numbers = [rng.choice(SPECIAL) if special else rng.gauss(0, 1) for _ in range(NUMBERS)]
    return Script(function, labels, torch.tensor(numbers, dtype=torch.float64))


def _operation(rng, name, wires):
    places, function = rng.choices(range(NUMBERS), k=3), rng.choice(FUNCTIONS)
    constant = rng.choice(SPECIAL)
    if name in GATES and GATES[name].angles > 1:  # PennyLane's own do not mix numbers and tensors
        constant = torch.tensor(constant, dtype=torch.float64)
    alike = name in OTHERS or name == "IsingXY"  # PennyLane's own IsingXY has no gradient of a batch of angles
    kinds = [rng.choice(["weight", "feature"]) if name in OTHERS else "weight"] * 3
    if not alike:
        kinds = rng.choices(["weight", "feature", "number"], k=3)
    word = "".join(rng.choices("XYZ", k=rng.randint(1, len(wires))))  # of a word such as ZI, it loses a batch of one
    count = (GATES[name].wires or rng.randint(1, len(wires))) if name in GATES else len(wires)

    def queue(a, x):
        sources = {"weight": a, "feature": x}
        angles = [constant if kind == "number" else function(sources[kind][..., place])
                  for kind, place in zip(kinds, places, strict=True)]  # fmt: skip
        if name in OTHERS:
            return OTHERS[name][1](angles, wires)
        if name == "PauliRot":
            return qml.PauliRot(angles[0], word, wires=wires[: len(word)])
        return getattr(qml, name)(*angles[: GATES[name].angles], wires=wires[:count])

    return queue


def _amplitudes(rng, wires):
    """A state of some wires: of weights or samples, padded, normalised, or of constants that are not normalised."""
    k = rng.randint(1, min(len(wires), 2))
    kind, own = rng.choice(["weights", "samples", "padded", "complex", "constant"]), rng.sample(wires, k)
    constant = np.exp(1j * np.arange(2**k)) * rng.choice([1.0, 0.5])

    def queue(a, x):
        if kind == "constant":
            return qml.StatePrep(constant, wires=own, validate_norm=False)
        if kind == "complex":
            return qml.StatePrep(x[..., : 2**k] * torch.as_tensor(constant), wires=own, validate_norm=False)
        if kind == "padded":
            return qml.AmplitudeEmbedding(x[..., : 2**k - 1], wires=own, pad_with=0.3)
        values = x[..., : 2**k] if kind == "samples" else a[: 2**k] + 2
        return qml.AmplitudeEmbedding(values, wires=own, normalize=True)

    return queue


def _measurement(rng, kind, wires):
    word = "".join(rng.choices("XYZ", k=rng.randint(1, len(wires))))

    def measure(a):
        if kind == "state":
            return qml.state()
        if kind == "all probabilities":
            return qml.probs()
        if kind == "probs":
            return qml.probs(wires=wires[: len(word)])
        product = qml.prod(*(getattr(qml, letter)(wire) for letter, wire in zip(word, wires, strict=False)))
        if kind in ("hamiltonian", "weighted"):
            coefficients = [a[3] if kind == "weighted" else 0.4, -1.6, 0.7]
            return qml.expval(qml.dot(coefficients, [product, qml.X(wires[0]), qml.I(wires[0])]))
        return {"expval": qml.expval, "var": qml.var}[kind](product)

    return measure
