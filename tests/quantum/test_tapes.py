"""The device `qnerf.fast` against `default.qubit` on random tapes, and what else scripts for PennyLane meet."""

import os
from collections.abc import Callable
from importlib.metadata import entry_points
from typing import Any

import numpy as np
import pennylane as qml
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pennylane.exceptions import DeviceError
from torch import Tensor

from qnerf.quantum.gates import GATES
from qnerf.quantum.pennylane_device import FastDevice

LONG = os.environ.get("QNERF_HYPOTHESIS") == "long"
BATCH = 3
# Beyond the gates of the table: PennyLane decomposes these.
OTHERS = {
    "CSwap": lambda p, w: qml.ctrl(qml.SWAP(w[1:3]), w[0]),
    "Adjoint": lambda p, w: qml.adjoint(qml.CRX(p[0], wires=w[:2])),
    "Controlled": lambda p, w: qml.ctrl(qml.RY(p[0], wires=w[2]), w[:2], control_values=[0, 1]),
    "MultiControlledX": lambda p, w: qml.MultiControlledX(wires=w[:3]),
    "QubitUnitary": lambda p, w: qml.QubitUnitary(qml.matrix(qml.Rot(0.3, 0.4, 0.5, wires=0)), wires=w[0]),
    "TwoQubitUnitary": lambda p, w: qml.QubitUnitary(qml.matrix(qml.QFT([0, 1])), wires=w[:2]),
    "QFT": lambda p, w: qml.QFT(wires=w[:3]),
    "FermionicSWAP": lambda p, w: qml.FermionicSWAP(p[0], wires=w[:2]),
    "OrbitalRotation": lambda p, w: qml.OrbitalRotation(p[0], wires=w[:4]),
    "SingleExcitationPlus": lambda p, w: qml.SingleExcitationPlus(p[0], wires=w[:2]),
    "Select": lambda p, w: qml.Select([qml.RX(p[0], wires=w[1]), qml.RY(p[1], wires=w[1])], control=w[0]),
    "PrepSelPrep": lambda p, w: qml.PrepSelPrep(qml.dot([0.3, -0.4], [qml.X(w[1]), qml.Z(w[1])]), control=[w[0]]),
    "GlobalPhase": lambda p, w: qml.GlobalPhase(0.4),
}
WIDTHS = {"QubitUnitary": 1, "TwoQubitUnitary": 2, "Adjoint": 2, "FermionicSWAP": 2, "SingleExcitationPlus": 2,
          "OrbitalRotation": 4, "GlobalPhase": 1, "Select": 2, "PrepSelPrep": 2}  # fmt: skip
Script = Callable[[Tensor, Tensor], list[Any]]


@st.composite
def scripts(draw: st.DrawFn) -> tuple[int, Script]:
    """Wires, and a function of numbers (20,) and of samples (BATCH, 20) that queues gates and measurements."""
    n = draw(st.integers(1, 12 if LONG else 5))
    wires = st.permutations(range(n))
    gates: list[Callable[[Tensor, Tensor], Any]] = []
    if draw(st.booleans()):
        k = draw(st.integers(1, min(n, 3)))
        first = draw(wires)[:k]
        of_samples = draw(st.booleans())
        gates.append(
            lambda a, x: qml.AmplitudeEmbedding((x if of_samples else a)[..., : 2**k], wires=first, normalize=True)
        )
    for _ in range(draw(st.integers(1, 40 if LONG else 15))):
        names = [name for name in (*GATES, *OTHERS) if WIDTHS.get(name, 3 if name in OTHERS else width(name)) <= n]
        gates.append(draw(gate(draw(st.sampled_from(names)), draw(wires))))
    measurements: list[Callable[[], Any]] = []
    for _ in range(draw(st.integers(1, 3))):
        word = draw(st.text("XYZ", min_size=1, max_size=min(n, 4)))
        where = draw(wires)
        kind = draw(st.sampled_from(["expval", "var", "hamiltonian", "probs"]))
        measurements.append(lambda word=word, where=where, kind=kind: measurement(kind, word, where))

    def script(a: Tensor, x: Tensor) -> list[Any]:
        for queue in gates:
            queue(a, x)
        return [measure() for measure in measurements]

    return n, script


def width(name: str) -> int:
    return GATES[name].wires or 1


@st.composite
def gate(draw: st.DrawFn, name: str, wires: list[int]) -> Callable[[Tensor, Tensor], Any]:
    sources = draw(st.lists(st.tuples(st.booleans(), st.integers(0, 19)), min_size=3, max_size=3))

    def angles(a: Tensor, x: Tensor) -> list[Tensor]:
        # PennyLane's own IsingXY has no gradient of a batch of angles.
        return [x[:, place] if batched and name != "IsingXY" else a[place] for batched, place in sources]

    if name in OTHERS:
        return lambda a, x: OTHERS[name]([a[place] for _, place in sources], wires)
    if name == "PauliRot":
        word = draw(st.text("IXYZ", min_size=1, max_size=min(len(wires), 4)))
        return lambda a, x: qml.PauliRot(angles(a, x)[0], word, wires=wires[: len(word)])
    count = GATES[name].wires or draw(st.integers(1, len(wires)))
    return lambda a, x: getattr(qml, name)(*angles(a, x)[: GATES[name].angles], wires=wires[:count])


def measurement(kind: str, word: str, wires: list[int]) -> Any:
    if kind == "probs":
        return qml.probs(wires=wires[: len(word)])
    product = qml.prod(*(getattr(qml, letter)(wire) for letter, wire in zip(word, wires, strict=False)))
    if kind == "hamiltonian":
        return qml.expval(0.3 * product - 1.6 * qml.X(wires[0]) + 0.7 * qml.I(wires[0]))
    return {"expval": qml.expval, "var": qml.var}[kind](product)


def results(device: Any, script: Script) -> list[Tensor]:
    """Outputs, and gradients of the numbers and of the samples."""
    generator = torch.Generator().manual_seed(11)
    a = torch.randn(20, generator=generator, dtype=torch.float64).requires_grad_()
    x = (2 * torch.randn(BATCH, 20, generator=generator, dtype=torch.float64)).requires_grad_()
    node = qml.QNode(script, device, interface="torch", diff_method="backprop")
    values = [value.reshape(-1) for value in node(a, x)]
    total = sum((value.to(torch.float64) * torch.arange(1, 1 + len(value))).sum() for value in values)
    assert isinstance(total, Tensor)
    gradients = [torch.zeros_like(tensor) for tensor in (a, x)]
    if total.requires_grad:
        found = torch.autograd.grad(total, (a, x), allow_unused=True)
        gradients = [zero if one is None else one for zero, one in zip(gradients, found, strict=True)]
    return [torch.cat(values).detach(), *gradients]


@settings(max_examples=1000 if LONG else 25)
@given(drawn=scripts())
def test_random_tapes_equal_default_qubit(drawn: tuple[int, Script]) -> None:
    n, script = drawn
    fast = results(FastDevice(wires=n), script)
    slow = results(qml.device("default.qubit", wires=n), script)
    assert (fast[0] - slow[0]).abs().max() <= 1e-12
    for one, two in zip(fast[1:], slow[1:], strict=True):
        assert (one - two).abs().max() <= 1e-11 * max(1.0, float(two.abs().max()))


def test_the_device_is_found_by_its_name() -> None:
    found = {entry.name: entry.value for entry in entry_points(group="pennylane.plugins")}
    if "qnerf.fast" not in found:
        pytest.skip("the package was installed before it had the device")
    assert isinstance(qml.device("qnerf.fast", wires=2), FastDevice)


def test_other_interfaces_differentiate_by_parameter_shift() -> None:
    def script(angle: Any) -> Any:
        qml.RX(angle, wires="a")
        qml.CNOT(["a", "b"])
        return qml.expval(qml.Z("b"))

    angle = qml.numpy.array(0.4, requires_grad=True)
    node = qml.QNode(script, FastDevice(wires=["a", "b"]))
    assert np.isclose(node(angle), np.cos(0.4))
    assert np.isclose(qml.grad(node)(angle), -np.sin(0.4))


@pytest.mark.parametrize("method", ["adjoint", "device", "best"])
def test_methods_of_other_simulators_are_taken(method: str) -> None:
    node = qml.QNode(lambda x: qml.RX(x, wires=0) and qml.expval(qml.Z(0)), FastDevice(wires=1), diff_method=method)
    x = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)
    node(x).backward()
    assert x.grad is not None
    assert np.isclose(x.grad, -np.sin(0.4))
    assert np.isclose(qml.grad(node)(qml.numpy.array(0.4, requires_grad=True)), -np.sin(0.4))


def test_float32_parameters_are_computed_in_float32() -> None:
    node = qml.QNode(lambda x: qml.RX(x, wires=0) and qml.expval(qml.Z(0)), FastDevice(wires=1))
    x = torch.linspace(0, 3, 7)
    assert node(x).dtype == torch.float64
    assert 0 < (node(x) - x.double().cos()).abs().max() < 1e-6
    assert (node(x.double()) - x.double().cos()).abs().max() < 1e-15


def without(operation: Callable[[], Any], measure: Callable[[], Any]) -> Callable[[], Any]:
    def script() -> Any:
        operation()
        return measure()

    return script


@pytest.mark.parametrize(
    ("operation", "measure", "message"),
    [
        (lambda: qml.Beamsplitter(0.1, 0.2, wires=[0, 1]), lambda: qml.expval(qml.Z(0)), "Beamsplitter"),
        (lambda: qml.DepolarizingChannel(0.1, wires=0), lambda: qml.expval(qml.Z(0)), "DepolarizingChannel"),
        (lambda: qml.measure(0), lambda: qml.expval(qml.Z(0)), "MidMeasure"),
        (lambda: qml.X(0), qml.state, "state"),
    ],
)
def test_what_it_cannot_run_it_names(operation: Any, measure: Any, message: str) -> None:
    with pytest.raises(DeviceError, match=message):
        qml.QNode(without(operation, measure), FastDevice(wires=2))()


def test_shots_are_refused() -> None:
    with pytest.raises(DeviceError, match="is exact, got shots=10"):
        FastDevice(wires=2, shots=10)
    node = qml.set_shots(qml.QNode(lambda: qml.expval(qml.Z(0)), FastDevice(wires=1)), 10)
    with pytest.raises(DeviceError):
        node()
