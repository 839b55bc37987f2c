"""PennyLane's templates of qubits as QNodes with inputs and weights, for `from_qnode` and the table of the docs."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pennylane as qml


class Template(NamedTuple):
    """A template on `wires` wires: queue(inputs, w) for inputs of `features` and weights of `shape`, () for none."""

    wires: int
    features: int
    shape: tuple[int, ...]
    queue: Callable[[Any, Any], Any]


def _block(weights, wires):
    qml.RY(weights[0], wires=wires[0])
    qml.RY(weights[1], wires=wires[1])
    qml.CNOT(wires=wires)


HAMILTONIAN = 0.5 * qml.X(0) @ qml.Z(1) - 0.3 * qml.Y(2) + 0.8 * qml.Z(0)

FOLLOWING = {
    "BasicEntanglerLayers": (3, (2, 3), lambda w: qml.BasicEntanglerLayers(w, wires=range(3))),
    "StronglyEntanglingLayers": (
        3,
        (2, 3, 3),
        lambda w: qml.StronglyEntanglingLayers(w, wires=range(3), ranges=[1, 2]),
    ),
    "SimplifiedTwoDesign": (3, (2, 2, 2), lambda w: qml.SimplifiedTwoDesign([0.1, 0.2, 0.3], w, wires=range(3))),
    "RandomLayers": (3, (2, 4), lambda w: qml.RandomLayers(w, wires=range(3), seed=7)),
    "GateFabric": (4, (2, 1, 2), lambda w: qml.GateFabric(w, wires=range(4), init_state=[1, 1, 0, 0], include_pi=True)),
    "ParticleConservingU1": (3, (2, 2, 2), lambda w: qml.ParticleConservingU1(w, wires=range(3), init_state=[1, 0, 0])),
    "ParticleConservingU2": (3, (2, 5), lambda w: qml.ParticleConservingU2(w, wires=range(3), init_state=[1, 0, 0])),
    "MERA": (4, (5, 2), lambda w: qml.MERA(range(4), 2, _block, 2, w)),
    "MPS": (4, (3, 2), lambda w: qml.MPS(range(4), 2, _block, 2, w)),
    "TTN": (4, (3, 2), lambda w: qml.TTN(range(4), 2, _block, 2, w)),
    "TwoLocalSwapNetwork": (
        3,
        (3,),
        lambda w: qml.TwoLocalSwapNetwork(
            range(3), lambda index, wires, param: qml.CRX(param, wires=index), w, fermionic=False
        ),
    ),
    "ArbitraryUnitary": (2, (15,), lambda w: qml.ArbitraryUnitary(w, wires=range(2))),
    "ArbitraryStatePreparation": (2, (6,), lambda w: qml.ArbitraryStatePreparation(w, wires=range(2))),
    "FermionicSingleExcitation": (3, (1,), lambda w: qml.FermionicSingleExcitation(w[0], wires=[0, 1, 2])),
    "FermionicDoubleExcitation": (4, (1,), lambda w: qml.FermionicDoubleExcitation(w[0], wires1=[0, 1], wires2=[2, 3])),
    "ApproxTimeEvolution": (3, (1,), lambda w: qml.ApproxTimeEvolution(HAMILTONIAN, w[0], 2)),
    "CommutingEvolution": (3, (1,), lambda w: qml.CommutingEvolution(qml.X(0) @ qml.X(1) + 0.5 * qml.X(2), w[0])),
    "TrotterProduct": (3, (1,), lambda w: qml.TrotterProduct(HAMILTONIAN, w[0], n=2, order=2)),
    "BasisRotation": (3, (), lambda w: qml.BasisRotation(range(3), np.linalg.qr(np.array(BASIS))[0])),
    "QFT": (3, (), lambda w: qml.QFT(wires=range(3))),
    "AQFT": (3, (), lambda w: qml.AQFT(order=1, wires=range(3))),
    "GroverOperator": (3, (), lambda w: qml.GroverOperator(wires=range(3))),
    "Permute": (3, (), lambda w: qml.Permute([2, 0, 1], wires=range(3))),
    "FlipSign": (3, (), lambda w: qml.FlipSign([1, 0, 1], wires=range(3))),
    "Reflection": (3, (1,), lambda w: qml.Reflection(qml.Hadamard(0), w[0])),
    "ControlledSequence": (3, (1,), lambda w: qml.ControlledSequence(qml.RX(w[0], wires=2), control=[0, 1])),
    "Select": (3, (2,), lambda w: qml.Select([qml.RX(w[0], wires=2), qml.RY(w[1], wires=2)], control=[0])),
    "QROM": (4, (), lambda w: qml.QROM([[1, 0], [0, 1]], [0], [1, 2], None)),
    "Adder": (3, (), lambda w: qml.Adder(3, range(3))),
    "SelectPauliRot": (3, (4,), lambda w: qml.SelectPauliRot(w, control_wires=[0, 1], target_wire=2, rot_axis="Y")),
    "FABLE": (3, (), lambda w: qml.FABLE(np.array([[0.1, 0.2], [0.3, -0.2]]), wires=range(3), tol=0)),
    "PhaseAdder": (3, (), lambda w: qml.PhaseAdder(3, range(3))),
    "Multiplier": (5, (), lambda w: qml.Multiplier(3, [0, 1], mod=4, work_wires=[2, 3])),
    "OutAdder": (6, (), lambda w: qml.OutAdder([0, 1], [2, 3], [4, 5])),
    "OutMultiplier": (6, (), lambda w: qml.OutMultiplier([0, 1], [2, 3], [4, 5])),
    "OutPoly": (4, (), lambda w: qml.OutPoly(lambda x: x**2, input_registers=[[0, 1]], output_wires=[2, 3])),
    "SemiAdder": (5, (), lambda w: qml.SemiAdder([0, 1], [2, 3], [4])),
    "TemporaryAND": (3, (), lambda w: qml.TemporaryAND(wires=range(3))),
    "AmplitudeAmplification": (
        2,
        (),
        lambda w: qml.AmplitudeAmplification(qml.Hadamard(0) @ qml.Hadamard(1), qml.FlipSign(1, wires=[0, 1]), 2),
    ),
    "PrepSelPrep": (3, (), lambda w: qml.PrepSelPrep(qml.dot([0.3, -0.4], [qml.X(2), qml.Z(2)]), control=[0])),
    "Qubitization": (3, (), lambda w: qml.Qubitization(qml.dot([0.3, -0.4], [qml.X(2), qml.Z(2)]), control=[0])),
    "QDrift": (3, (), lambda w: qml.QDrift(HAMILTONIAN, time=0.4, n=3, seed=1)),
    "QSVT": (
        2,
        (),
        lambda w: qml.QSVT(
            qml.BlockEncode(np.array([[0.1, 0.2], [0.3, 0.4]]), wires=[0, 1]),
            [qml.PCPhase(angle, dim=2, wires=[0, 1]) for angle in (0.1, 0.2, 0.3)],
        ),
    ),
    "ModExp": (7, (), lambda w: qml.ModExp([0], [1, 2], base=3, mod=4, work_wires=[3, 4])),
    "HilbertSchmidt": (2, (1,), lambda w: qml.HilbertSchmidt([qml.RZ(w[0], wires=0)], [qml.Hadamard(1)])),
}
"""Templates without features of their own, which follow an AngleEmbedding: wires, shape of the weights, queue(w)."""

STARTING = {
    "BasisEmbedding": (3, lambda: qml.BasisEmbedding([1, 0, 1], wires=range(3))),
    "MottonenStatePreparation": (2, lambda: qml.MottonenStatePreparation([0.5, 0.5, 0.1, 0.7], wires=range(2))),
    "CosineWindow": (3, lambda: qml.CosineWindow(wires=range(3))),
    "Superposition": (
        3,
        lambda: qml.Superposition(np.array([0.6, 0.8]), np.array([[0, 1], [1, 1]]), wires=[0, 1], work_wire=2),
    ),
    "MultiplexerStatePreparation": (
        2,
        lambda: qml.MultiplexerStatePreparation(np.array([0.5, 0.5, 0.5, 0.5]), wires=range(2)),
    ),
    "MPSPrep": (3, lambda: qml.MPSPrep(MPS_STATE, wires=[1, 2], work_wires=[0])),
    "QROMStatePreparation": (
        5,
        lambda: qml.QROMStatePreparation(np.array([0.6, 0.8]), wires=[0], precision_wires=[1, 2], work_wires=[3, 4]),
    ),
}
"""Templates that prepare a state, before an AngleEmbedding: wires, queue()."""

TEMPLATES = {
    "AmplitudeEmbedding": Template(
        3, 5, (), lambda x, w: qml.AmplitudeEmbedding(x, wires=range(3), pad_with=0.25, normalize=True)
    ),
    "AngleEmbedding": Template(3, 3, (), lambda x, w: qml.AngleEmbedding(x, wires=range(3))),
    "IQPEmbedding": Template(3, 3, (), lambda x, w: qml.IQPEmbedding(x, wires=range(3), n_repeats=2)),
    "QAOAEmbedding": Template(3, 2, (2, 6), lambda x, w: qml.QAOAEmbedding(x, w, wires=range(3))),
    "AllSinglesDoubles": Template(
        4,
        0,
        (3,),
        lambda x, w: qml.AllSinglesDoubles(
            w, range(4), np.array([1, 1, 0, 0]), singles=[[0, 2], [1, 3]], doubles=[[0, 1, 2, 3]]
        ),
    ),
    "UCCSD": Template(
        4,
        0,
        (3,),
        lambda x, w: qml.UCCSD(w, range(4), [[0, 1, 2], [1, 2, 3]], [[[0, 1], [2, 3]]], np.array([1, 1, 0, 0])),
    ),
    "kUpCCGSD": Template(
        4, 0, (1, 6), lambda x, w: qml.kUpCCGSD(w, range(4), k=1, delta_sz=0, init_state=np.array([1, 1, 0, 0]))
    ),
    "QuantumPhaseEstimation": Template(
        3, 1, (), lambda x, w: qml.QuantumPhaseEstimation(qml.RZ(x[..., 0], wires=0), estimation_wires=[1, 2])
    ),
    "QuantumMonteCarlo": Template(
        5,
        1,
        (),
        lambda x, w: (
            qml.QuantumMonteCarlo(
                np.array([0.25, 0.75]), lambda i: 0.5 * i, target_wires=[0, 1], estimation_wires=[2, 3]
            ),
            qml.RX(x[..., 0], wires=4),
        ),
    ),
}
BASIS = [[1.0, 0.2, 0.3], [0.1, 1.0, 0.4], [0.5, 0.3, 1.0]]
MPS_STATE = [np.array([[0.0, 0.107], [0.994, 0.0]]), np.array([[0.0, 1.0], [1.0, 0.0]])]


def _encoded(wires, shape, queue, starting=False):
    def both(inputs, w):
        if starting:
            queue()
        qml.AngleEmbedding(inputs, wires=range(wires), rotation="Y")
        if not starting:
            queue(w)

    return Template(wires, wires, shape, both)


TEMPLATES |= {name: _encoded(*own) for name, own in FOLLOWING.items()}
TEMPLATES |= {name: _encoded(wires, (), queue, starting=True) for name, (wires, queue) in STARTING.items()}
