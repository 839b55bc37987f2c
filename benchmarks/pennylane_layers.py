"""Layers of PennyLane's demos: TorchLayer on default.qubit, TorchLayer on qnerf.fast, and `from_qnode`.

    OMP_NUM_THREADS=1 python -m benchmarks.pennylane_layers

Milliseconds of processor time of a forward and backward pass, medians; one thread. Prints the rows of the table in
docs/quantum.md, and saves `benchmarks/results/pennylane_layers.parquet`.
"""

import argparse
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


DEMOS = {
    "AngleEmbedding, BasicEntanglerLayers": Demo(2, 2, {"weights": (6, 2)}, turning_layers),
    "AngleEmbedding, StronglyEntanglingLayers": Demo(4, 4, {"weights": (3, 4, 3)}, strongly),
    "quantum transfer learning": Demo(4, 4, {"weights": (6, 4)}, transfer),
    "IQPEmbedding, BasicEntanglerLayers": Demo(6, 6, {"weights": (3, 6)}, iqp),
    "re-uploading, S = 3": Demo(6, 6, {"weights": (4, 1, 6, 3)}, reuploading),
    "AmplitudeEmbedding, probabilities": Demo(5, 20, {"weights": (2, 5, 3)}, amplitudes),
}


def milliseconds(layer: nn.Module, x: torch.Tensor, repeats: int) -> float:
    """Processor time of a step, median."""
    times = []
    for _ in range(repeats + 1):
        start = time.process_time()
        layer(x).square().sum().backward()
        times.append(time.process_time() - start)
    return 1e3 * statistics.median(times[1:])


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
            for kind, layer in layers.items():
                error = float((layer(x) - expected).detach().abs().max())
                time_taken = milliseconds(layer, x, options.repeats)
                rows.append({"circuit": name, "wires": demo.wires, "layer": kind, "batch": batch, "ms": time_taken, "error": error})  # fmt: skip # noqa: E501
        cells = [f"{row['ms']:.3g}" for row in rows[-6:]]
        print(f"| {name} | {demo.wires} | {' | '.join(cells)} |", flush=True)
    frame = pd.DataFrame(rows)
    print(f"largest difference from default.qubit: {frame['error'].max():.1e}")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    frame.to_parquet(options.out)


if __name__ == "__main__":
    main()
