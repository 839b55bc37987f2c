"""The speed of circuits as PennyLane's users write them: `python -m benchmarks.user_circuits --commit COMMIT`.

Forward + backward of 1,024 samples in float32, in turn: of each QNode as `from_qnode`, whose calls make PennyLane's
tape, as PennyLane's TorchLayer on the devices default.qubit and qnerf.fast, and as
`QuantumLayer(layer.circuit(features))`. Before them QIREN and circuits of Gates with as many of them (6,144 samples).
Rows are saved as benchmarks/results/user_circuits.parquet, with the processor; those of other commits and threads stay.
An older commit is measured with PYTHONPATH=<its src>.
"""

import argparse
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pennylane as qml
import torch
from torch import nn

from benchmarks.training import processor
from qnerf.quantum import QuantumLayer, from_qnode
from qnerf.quantum.circuit import Circuit, Gate, Weights, feature

RESULTS = Path(__file__).parent / "results" / "user_circuits.parquet"
SAMPLES = 1024
TREE = [(0, 1), (2, 3), (4, 5), (6, 7), (1, 3), (5, 7), (3, 7)]


class Case(NamedTuple):
    """`queue(inputs, w)` on `wires` wires, for inputs (B, features) and weights of `shape`, then `measured`."""

    wires: int
    features: int
    shape: tuple[int, ...]
    queue: Callable[[Any, Any], None]
    measured: Callable[[int], Any] = lambda wires: [qml.expval(qml.Z(wire)) for wire in range(wires)]


def last(wires: int) -> Any:
    return qml.expval(qml.Z(wires - 1))


def after_angles(
    wires: int, shape: tuple[int, ...], queue: Callable[[Any, int], Any], rotation: str = "X", **options: Any
) -> Case:
    def both(inputs: Any, w: Any) -> None:
        qml.AngleEmbedding(inputs, wires=range(wires), rotation=rotation)
        queue(w, wires)

    return Case(wires, wires, shape, both, **options)


def strong(w: Any, wires: int) -> None:
    qml.StronglyEntanglingLayers(w, wires=range(wires))


def pairs(places: list[tuple[int, int]]) -> Callable[[Any, int], None]:
    def queue(w: Any, wires: int) -> None:
        for k, (a, b) in enumerate(places):
            qml.RY(w[k, 0], wires=a)
            qml.RY(w[k, 1], wires=b)
            qml.CNOT([a, b])

    return queue


def hardware_efficient(wires: int, layers: int) -> Case:
    def queue(inputs: Any, w: Any) -> None:
        for layer in range(layers):
            for wire in range(wires):
                qml.RX(w[layer, wire, 0], wires=wire)
                qml.RZ(w[layer, wire, 1], wires=wire)
            for wire in range(wires - 1):
                qml.CNOT([wire, wire + 1])
            for wire in range(wires):
                qml.RZ(inputs[..., wire], wires=wire)
        for wire in range(wires):
            qml.RX(w[0, wire, 0], wires=wire)

    return Case(wires, wires, (layers, wires, 2), queue)


def iqp(wires: int) -> Case:
    def queue(inputs: Any, w: Any) -> None:
        qml.IQPEmbedding(inputs, wires=range(wires), n_repeats=2)
        qml.BasicEntanglerLayers(w, wires=range(wires))

    return Case(wires, wires, (2, wires), queue)


def feature_map(wires: int) -> Case:
    def queue(inputs: Any, w: Any) -> None:
        for _ in range(2):
            for a in range(wires):
                qml.Hadamard(a)
                qml.PhaseShift(2 * inputs[..., a], wires=a)
            for a in range(wires):
                for b in range(a + 1, wires):
                    qml.CNOT([a, b])
                    qml.PhaseShift(2 * (np.pi - inputs[..., a]) * (np.pi - inputs[..., b]), wires=b)
                    qml.CNOT([a, b])
        for wire in range(wires):
            qml.RY(w[wire], wires=wire)

    return Case(wires, wires, (wires,), queue)


def qaoa(wires: int) -> Case:
    shape = (2, 2 * wires)
    return Case(wires, wires, shape, lambda inputs, w: qml.QAOAEmbedding(inputs, w, wires=range(wires)))


def amplitudes(wires: int) -> Case:
    def queue(inputs: Any, w: Any) -> None:
        qml.AmplitudeEmbedding(inputs, wires=range(wires), normalize=True)
        strong(w, wires)

    return Case(wires, 2**wires, (2, wires, 3), queue)


def qiren(wires: int, spectral: int) -> Case:
    def queue(inputs: Any, w: Any) -> None:
        for block in range(spectral + 1):
            for layer in range(2):
                for wire in range(wires):
                    qml.Rot(*w[2 * block + layer, wire], wires=wire)
                for wire in range(wires):
                    qml.CZ([wire, (wire + layer + 1) % wires])
            for wire in range(wires) if block < spectral else ():
                qml.RZ(inputs[..., wire], wires=wire)

    return Case(wires, wires, (2 * (spectral + 1), wires, 3), queue)


def basic(wires: int, layers: int, gate: Any, rotation: str = "Y") -> Case:
    return after_angles(
        wires, (layers, wires), lambda w, n: qml.BasicEntanglerLayers(w, wires=range(n), rotation=gate), rotation
    )


def drawn(wires: int, rotations: int) -> Case:
    return after_angles(wires, (3, rotations), lambda w, n: qml.RandomLayers(w, wires=range(n), seed=3))


CASES = {
    "QIREN 8, S = 1": qiren(8, 1),
    "QIREN 8, S = 2": qiren(8, 2),
    "QIREN 8, S = 4": qiren(8, 4),
    "strongly entangling 4": after_angles(4, (3, 4, 3), strong),
    "strongly entangling 8": after_angles(8, (3, 8, 3), strong),
    "basic entangler RX 4": basic(4, 3, qml.RX),
    "basic entangler RY 8": basic(8, 4, qml.RY),
    "basic entangler RX 10": basic(10, 2, qml.RX),
    "random layers 4": drawn(4, 8),
    "random layers 8": drawn(8, 12),
    "hardware efficient 6": hardware_efficient(6, 3),
    "hardware efficient 8": hardware_efficient(8, 3),
    "IQP 4": iqp(4),
    "IQP 6": iqp(6),
    "IQP 8": iqp(8),
    "ZZ feature map 4": feature_map(4),
    "ZZ feature map 6": feature_map(6),
    "QAOA embedding 4": qaoa(4),
    "QAOA embedding 6": qaoa(6),
    "MPS 8": after_angles(8, (7, 2), pairs([(k, k + 1) for k in range(7)]), measured=last),
    "tree tensor 8": after_angles(8, (7, 2), pairs(TREE), measured=last),
    "amplitudes 5": amplitudes(5),
    "amplitudes 8": amplitudes(8),
    "probabilities 6": after_angles(6, (2, 6, 3), strong, measured=lambda wires: qml.probs(wires=range(3))),
}


def layers_of(case: Case) -> dict[str, nn.Module]:
    """The layers of a QNode, by how it is called."""

    def function(inputs: Any, w: Any) -> Any:
        case.queue(inputs, w)
        return case.measured(case.wires)

    default, fast = (
        qml.QNode(function, qml.device(name, wires=case.wires), interface="torch")
        for name in ("default.qubit", "qnerf.fast")
    )
    own, shapes = from_qnode(default, {"w": case.shape}), {"w": case.shape}
    layers = {"from_qnode": own, "qnerf.fast": qml.qnn.TorchLayer(fast, shapes)}
    if case.features == case.wires:  # a circuit cannot normalise the amplitudes of its input
        layers["QuantumLayer"] = QuantumLayer(own.circuit(case.features))
    return layers | {"default.qubit": qml.qnn.TorchLayer(default, shapes)}


def of_gates(axes: str, gate: str, pairs: Callable[[int], list[tuple[int, int]]], wires: int = 8) -> Circuit:
    """QIREN with S = 2 as a user would write it, gate by gate: rotations about other axes, and other pairs."""
    w = Weights("w", (3, 2, wires, len(axes)))
    gates = []
    for block in range(3):
        for layer in range(2):
            for wire in range(wires):
                for axis, angle in zip(axes, w[block, layer, wire], strict=True):
                    gates.append(Gate(f"R{axis}", (wire,), (angle,)))
            gates += [Gate(gate, pair) for pair in pairs(layer)]
        if block < 2:
            gates += [Gate("RZ", (wire,), (feature(wire),)) for wire in range(wires)]
    observables = tuple(((wire, "Z"),) for wire in range(wires))
    return Circuit("gates", wires, operations=tuple(gates), observables=observables, features=wires, weights=(w,))


def ring(layer: int) -> list[tuple[int, int]]:
    return [(wire, (wire + layer + 1) % 8) for wire in range(8)]


def bricks(layer: int) -> list[tuple[int, int]]:
    return [(wire, (wire + 1) % 8) for first in (0, 1) for wire in range(first, 8, 2)]


OWN = {
    "QIREN 8 of gates": ("ZYZ", "CZ", ring),
    "RX RZ RX, ring of CZ": ("XZX", "CZ", ring),
    "RX RZ RX, bricks of CZ": ("XZX", "CZ", bricks),
    "RX RZ RX, ring of CNOT": ("XZX", "CNOT", ring),
    "RX RZ RX, bricks of CNOT": ("XZX", "CNOT", bricks),
}
"""As many gates as QIREN has, and the same inputs and outputs."""


def step(layer: nn.Module, x: torch.Tensor) -> tuple[float, float]:
    """CPU and wall-clock milliseconds of forward + backward."""
    start = time.process_time(), time.perf_counter()
    y = layer(x)
    y.backward(torch.ones_like(y))
    return 1e3 * (time.process_time() - start[0]), 1e3 * (time.perf_counter() - start[1])


def timed(layers: Mapping[str, nn.Module], samples: int, features: int, repeats: int) -> dict[str, dict[str, float]]:
    """Of each layer the median CPU and the smallest wall-clock time, in turn, after two calls that do not count.

    `times_first`: the median ratio of its CPU time to that of the first layer.
    """
    x = torch.randn(samples, features).requires_grad_()
    rounds = [{name: step(layer, x) for name, layer in layers.items()} for _ in range(repeats + 2)][2:]
    first = next(iter(layers))
    return {
        name: {
            "cpu_ms": median(each[name][0] for each in rounds),
            "ms_min": min(each[name][1] for each in rounds),
            "times_first": median(each[name][0] / each[first][0] for each in rounds),
        }
        for name in layers
    }


def measured(repeats: int, every: bool) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []

    def add(layers: Mapping[str, nn.Module], samples: int, features: int, **about: str) -> None:
        for name, row in timed(layers, samples, features, repeats).items():
            own = {"circuit": name, "call": name} | about
            rows.append(own | {"samples": samples} | row)
            print(f"{own['circuit']} {own['call']} {row['cpu_ms']:.2f} ms, times {row['times_first']:.2f}", flush=True)

    own = {"QIREN 8": QuantumLayer(8, 2), **{k: QuantumLayer(of_gates(*v)) for k, v in OWN.items()}}
    add(own, 6144, 8, call="QuantumLayer")
    for name, case in CASES.items() if every else ():
        add(layers_of(case), SAMPLES, case.features, circuit=name)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--commit", required=True, help="what is measured")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--own", action="store_true", help="QIREN and circuits with as many gates alone")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    warnings.simplefilter("ignore")
    about = {"threads": options.threads, "processor": processor(), "commit": options.commit}
    table = pd.DataFrame(measured(options.repeats, not options.own)).assign(**about)
    if RESULTS.exists():
        old = pd.read_parquet(RESULTS)
        same = (old["commit"] == options.commit) & (old["threads"] == options.threads)
        same &= old["circuit"].isin(table["circuit"])
        table = pd.concat([old[~same], table], ignore_index=True)
    table.to_parquet(RESULTS, index=False)


if __name__ == "__main__":
    main()
