"""Layers of PennyLane's demos: TorchLayer on default.qubit, TorchLayer on qnerf.fast, and `from_qnode`.

    OMP_NUM_THREADS=1 python -m benchmarks.pennylane_layers

Milliseconds of processor time of a forward and backward pass, medians; one thread. Prints the rows of the table in
docs/quantum.md, and saves `benchmarks/results/pennylane_layers.parquet`.
"""

import argparse
import math
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import pennylane as qml
import torch
from torch import nn

from qnerf.quantum import from_qnode


class Demo(NamedTuple):
    wires: int
    features: int
    shapes: dict[str, tuple[int, ...]]
    function: Callable[..., Any]


def z_of(wires: int) -> list[Any]:
    return [qml.expval(qml.Z(wire)) for wire in range(wires)]


def turning_layers(inputs: Any, weights: Any) -> Any:
    """Turning quantum nodes into Torch layers."""
    qml.AngleEmbedding(inputs, wires=range(2))
    qml.BasicEntanglerLayers(weights, wires=range(2))
    return z_of(2)


def strongly(inputs: Any, weights: Any) -> Any:
    qml.AngleEmbedding(inputs, wires=range(4))
    qml.StronglyEntanglingLayers(weights, wires=range(4))
    return z_of(4)


def transfer(inputs: Any, weights: Any) -> Any:
    """Quantum transfer learning."""
    for wire in range(4):
        qml.Hadamard(wire)
        qml.RY(inputs[..., wire], wires=wire)
    for layer in range(6):
        for first, second in ((0, 1), (2, 3), (1, 2)):
            qml.CNOT(wires=[first, second])
        for wire in range(4):
            qml.RY(weights[layer, wire], wires=wire)
    return z_of(4)


def iqp(inputs: Any, weights: Any) -> Any:
    qml.IQPEmbedding(inputs, wires=range(6), n_repeats=2)
    qml.BasicEntanglerLayers(weights, wires=range(6), rotation=qml.RY)
    return z_of(6)


def reuploading(inputs: Any, weights: Any) -> Any:
    """Quantum models as Fourier series, on six wires."""
    for layer in range(3):
        qml.StronglyEntanglingLayers(weights[layer], wires=range(6))
        qml.AngleEmbedding(inputs, wires=range(6), rotation="X")
    qml.StronglyEntanglingLayers(weights[3], wires=range(6))
    return [qml.expval(qml.Z(0) @ qml.Z(1)), qml.expval(qml.X(5))]


def amplitudes(inputs: Any, weights: Any) -> Any:
    """A classifier of amplitudes, as in the variational classifier."""
    qml.AmplitudeEmbedding(inputs, wires=range(5), pad_with=0.25, normalize=True)
    qml.StronglyEntanglingLayers(weights, wires=range(5))
    return qml.probs(wires=range(2))


def one_qubit(inputs: Any, weights: Any) -> Any:
    """A classifier on one qubit that uploads three features again and again."""
    for layer in range(4):
        qml.Rot(inputs[..., 0], inputs[..., 1], inputs[..., 2], wires=0)
        qml.Rot(*(weights[layer, kind] for kind in range(3)), wires=0)
    return qml.expval(qml.Z(0))


def quanvolution(inputs: Any, weights: Any) -> Any:
    """Quanvolutional networks: the four pixels of a patch."""
    for wire in range(4):
        qml.RY(math.pi * inputs[..., wire], wires=wire)
    for layer in range(2):
        for wire in range(4):
            qml.RX(weights[layer, wire], wires=wire)
        qml.CNOT(wires=[layer, 3 - layer])
    return z_of(4)


def generator(inputs: Any, weights: Any) -> Any:
    """The generator of a quantum GAN: probabilities of five qubits, one of them an ancilla."""
    for wire in range(5):
        qml.RY(inputs[..., wire], wires=wire)
    for layer in range(6):
        for wire in range(5):
            qml.RY(weights[layer, wire], wires=wire)
        for wire in range(4):
            qml.CZ(wires=[wire, wire + 1])
    return qml.probs(wires=range(5))


def metric_learning(inputs: Any, weights: Any) -> Any:
    """Embeddings and metric learning: QAOAEmbedding, and a Hamiltonian of neighbours."""
    qml.QAOAEmbedding(inputs, weights, wires=range(4))
    words = [qml.Z(wire) @ qml.Z(wire + 1) for wire in range(3)]
    return qml.expval(qml.Hamiltonian([0.5, -1.0, 0.25], words))


DEMOS = {
    "AngleEmbedding, BasicEntanglerLayers": Demo(2, 2, {"weights": (6, 2)}, turning_layers),
    "AngleEmbedding, StronglyEntanglingLayers": Demo(4, 4, {"weights": (3, 4, 3)}, strongly),
    "quantum transfer learning": Demo(4, 4, {"weights": (6, 4)}, transfer),
    "IQPEmbedding, BasicEntanglerLayers": Demo(6, 6, {"weights": (3, 6)}, iqp),
    "re-uploading, S = 3": Demo(6, 6, {"weights": (4, 1, 6, 3)}, reuploading),
    "AmplitudeEmbedding, probabilities": Demo(5, 20, {"weights": (2, 5, 3)}, amplitudes),
    "one qubit, uploaded again": Demo(1, 3, {"weights": (4, 3)}, one_qubit),
    "quanvolution": Demo(4, 4, {"weights": (2, 4)}, quanvolution),
    "generator of a GAN": Demo(5, 5, {"weights": (6, 5)}, generator),
    "QAOAEmbedding, Hamiltonian": Demo(4, 4, {"weights": (2, 8)}, metric_learning),
}


def milliseconds(layers: dict[str, nn.Module], x: torch.Tensor, repeats: int) -> dict[str, float]:
    """Processor time of a step of each layer, medians. They take turns: a busy machine slows all alike.

    A turn of one sample is a run of ten steps, so that a step follows another one of the same layer.
    """
    times: dict[str, list[float]] = {name: [] for name in layers}
    steps = 10 if len(x) == 1 else 1
    for _ in range(repeats + 1):
        for name, layer in layers.items():
            start = time.process_time()
            for _ in range(steps):
                layer(x).square().sum().backward()
            times[name].append((time.process_time() - start) / steps)
    return {name: 1e3 * statistics.median(own[1:]) for name, own in times.items()}


def layers_of(demo: Demo) -> dict[str, nn.Module]:
    """The three layers, with the same weights."""
    nodes = {
        name: qml.QNode(demo.function, qml.device(name, wires=demo.wires)) for name in ("default.qubit", "qnerf.fast")
    }
    layers: dict[str, nn.Module] = {name: qml.qnn.TorchLayer(node, demo.shapes) for name, node in nodes.items()}
    layers["from_qnode"] = from_qnode(nodes["default.qubit"], demo.shapes)
    for layer in layers.values():
        layer.load_state_dict(layers["default.qubit"].state_dict())
    return layers


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "pennylane_layers.parquet")
    options = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)
    rows = []
    for name, demo in DEMOS.items():
        layers = layers_of(demo)
        for batch in (1, 1024):
            x = torch.rand(batch, demo.features, requires_grad=True)
            expected = layers["default.qubit"](x)
            for kind, taken in milliseconds(layers, x, options.repeats).items():
                error = float((layers[kind](x) - expected).detach().abs().max())
                row = {"circuit": name, "wires": demo.wires, "layer": kind, "batch": batch}
                rows.append(row | {"ms": taken, "error": error})
        cells = [f"{row['ms']:.3g}" for row in rows[-6:]]
        print(f"| {name} | {demo.wires} | {' | '.join(cells)} |", flush=True)
    frame = pd.DataFrame(rows)
    print(f"largest difference from default.qubit: {frame['error'].max():.1e}")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    frame.to_parquet(options.out)


if __name__ == "__main__":
    main()
