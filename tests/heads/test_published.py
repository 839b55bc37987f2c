"""`load_published` against the published layer, built here from PennyLane's own template and TorchLayer."""

import pennylane as qml
import pytest
import torch
from torch import Tensor, nn

from qnerf.heads import HEADS
from qnerf.heads.published import load_published

WIRES, SPECTRAL = 4, 2


def torch_layer() -> qml.qnn.TorchLayer:
    @qml.qnode(qml.device("default.qubit", wires=WIRES))
    def circuit(inputs, weights1, weights2):
        for block in weights1:
            qml.StronglyEntanglingLayers(block, wires=range(WIRES), imprimitive=qml.CZ)
            for wire in range(WIRES):
                qml.RZ(inputs[:, wire], wires=wire)
        qml.StronglyEntanglingLayers(weights2, wires=range(WIRES), imprimitive=qml.CZ)
        return [qml.expval(qml.PauliZ(wire)) for wire in range(WIRES)]

    return qml.qnn.TorchLayer(circuit, {"weights1": (SPECTRAL, 2, WIRES, 3), "weights2": (2, WIRES, 3)})


class Published(nn.Module):
    """The layout and the names of the published module."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Sequential()
        for index, size in enumerate((5, WIRES)):
            layer = nn.Module()
            layer.clayer, layer.norm, layer.qlayer = nn.Linear(size, WIRES), nn.BatchNorm1d(WIRES), nn.Module()
            layer.qlayer.qnn = torch_layer()
            self.net.add_module(str(index), layer)
        self.net.add_module("2", nn.Linear(WIRES, 3))

    def forward(self, x: Tensor) -> Tensor:
        first, second, last = self.net
        for layer in (first, second):
            x = layer.qlayer.qnn(layer.norm(layer.clayer(x)))
        return last(x)


@pytest.fixture(scope="module")
def published() -> Published:
    torch.manual_seed(0)
    module = Published()
    for _ in range(3):
        module(torch.randn(16, 5))  # batch normalisation has statistics then
    return module.eval()


def head(**options: object) -> nn.Module:
    return HEADS.build("qiren", 5, 3, **({"layers": 1, "spectral": SPECTRAL, "qubits": WIRES} | options)).eval()


def test_published_head_gives_its_values(published):
    ours, x = head(), torch.randn(7, 5)
    assert not torch.allclose(ours(x), published(x), atol=1e-2)
    state = {f"_model.field.mlp_head.{name}": tensor for name, tensor in published.state_dict().items()}
    load_published(ours, state | {"_model.field.mlp_base.weight": torch.ones(2)}, "_model.field.mlp_head.")
    torch.testing.assert_close(ours(x), published(x).to(torch.float32), rtol=0, atol=2e-6)


def test_checkpoints_that_do_not_fit_are_one_line(published):
    for options, change, message in (
        ({"gain": 2.0}, {}, "gain=1"),
        ({"input_scale": 0.3}, {}, "input_scale=1"),
        ({"layers": 2}, {}, "of 3 circuits: missing hybrid.2.circuit.weights1"),
        ({"spectral": 1}, {}, r"hybrid.0.circuit.weights1: expected shape \(1, 2, 4, 3\), got \(2, 2, 4, 3\)"),
        ({}, {"net.0.frobnicator": torch.ones(1)}, "left over readout.frobnicator"),
        ({}, {"net.x.weight": torch.ones(1)}, "net.x.weight: not a name of a published head"),
    ):
        with pytest.raises(ValueError, match=message):
            load_published(head(**options), published.state_dict() | change)
