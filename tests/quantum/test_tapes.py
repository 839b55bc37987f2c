"""`qnerf.fast` and `from_qnode` against `default.qubit` on random QNodes, and what else scripts for PennyLane meet."""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np
import pennylane as qml
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pennylane.exceptions import DeviceError, WireError
from torch import Tensor, nn

from qnerf.quantum import from_qnode
from qnerf.quantum.gates import GATES
from qnerf.quantum.pennylane_device import FastDevice

LONG = os.environ.get("QNERF_HYPOTHESIS") == "long"
# Beyond the gates of the table: PennyLane decomposes these.
OTHERS = {
    "Controlled": lambda p, w: qml.ctrl(qml.RY(p[0], wires=w[2]), w[:2], control_values=[0, 1]),
    "MultiControlledX": lambda p, w: qml.MultiControlledX(wires=w[:3]),
    "QubitUnitary": lambda p, w: qml.QubitUnitary(qml.matrix(qml.Rot(0.3, 0.4, 0.5, wires=0)), wires=w[0]),
    "Select": lambda p, w: qml.Select([qml.RX(p[0], wires=w[1]), qml.RY(p[1], wires=w[1])], control=w[0]),
    "PrepSelPrep": lambda p, w: qml.PrepSelPrep(qml.dot([0.3, -0.4], [qml.X(w[1]), qml.Z(w[1])]), control=[w[0]]),
    "GlobalPhase": lambda p, w: qml.GlobalPhase(0.4),
}
WIDTHS = {"QubitUnitary": 1, "GlobalPhase": 1, "Select": 2, "PrepSelPrep": 2}
Script = Callable[[Any, Tensor], Any]
FUNCTIONS: list[Callable[[Tensor], Tensor]] = [
    torch.sin,
    torch.square,
    lambda angle: np.pi * angle,
    lambda angle: angle,
]


@st.composite
def scripts(draw: st.DrawFn) -> tuple[int, Script]:
    """Wires, and a function of numbers (20,) and of samples (..., 20) that queues gates and returns measurements."""
    n = draw(st.integers(1, 6))
    wires = st.permutations(range(n))
    gates: list[Callable[[Tensor, Tensor], Any]] = []
    if draw(st.booleans()):
        gates.append(draw(amplitudes(draw(wires))))
    for _ in range(draw(st.integers(1, 15))):
        names = [name for name in (*GATES, *OTHERS) if WIDTHS.get(name, 3 if name in OTHERS else width(name)) <= n]
        gates.append(draw(gate(draw(st.sampled_from(names)), draw(wires))))
    measurements: list[Callable[[Tensor], Any]] = []
    kinds = ["expval", "var", "hamiltonian", "probs", "state" if draw(st.integers(0, 9)) == 0 else "expval"]
    for _ in range(draw(st.integers(1, 3))):
        word = draw(st.text("XYZ", min_size=1, max_size=min(n, 4)))
        where = draw(wires)
        kind = draw(st.sampled_from(kinds))
        measurements.append(lambda a, word=word, where=where, kind=kind: measurement(kind, word, where, a))
    container = draw(st.sampled_from([list, tuple]))

    def script(a: Tensor, x: Tensor) -> Any:
        for queue in gates:
            queue(a, x)
        return container(measure(a) for measure in measurements)

    return n, script


@st.composite
def amplitudes(draw: st.DrawFn, wires: list[int]) -> Callable[[Tensor, Tensor], Any]:
    """A state of some wires: of weights or samples, padded, normalised, or of constants that are not normalised."""
    k = draw(st.integers(1, min(len(wires), 3)))
    kind = draw(st.sampled_from(["weights", "samples", "padded", "complex", "constant"]))
    constant = np.exp(1j * np.arange(2**k)) * draw(st.sampled_from([1.0, 0.5]))

    def queue(a: Tensor, x: Tensor) -> Any:
        if kind == "constant":
            return qml.StatePrep(constant, wires=wires[:k], validate_norm=False)
        if kind == "complex":
            return qml.StatePrep(x[..., : 2**k] * torch.as_tensor(constant), wires=wires[:k], validate_norm=False)
        if kind == "padded":
            return qml.AmplitudeEmbedding(x[..., : 2**k - 1], wires=wires[:k], pad_with=0.3)
        return qml.AmplitudeEmbedding((x if kind == "samples" else a)[..., : 2**k], wires=wires[:k], normalize=True)

    return queue


def width(name: str) -> int:
    return GATES[name].wires or 1


@st.composite
def gate(draw: st.DrawFn, name: str, wires: list[int]) -> Callable[[Tensor, Tensor], Any]:
    sources = draw(st.lists(st.tuples(st.booleans(), st.integers(0, 19)), min_size=3, max_size=3))
    function = draw(st.sampled_from(FUNCTIONS))

    def angles(a: Tensor, x: Tensor) -> list[Tensor]:
        # PennyLane's own IsingXY has no gradient of a batch of angles.
        return [function(x[..., place] if batched and name != "IsingXY" else a[place]) for batched, place in sources]

    if name in OTHERS:
        return lambda a, x: OTHERS[name]([a[place] for _, place in sources], wires)
    if name == "PauliRot":
        # Of a word such as ZI, PennyLane loses a batch of one.
        word = draw(st.text("XYZ", min_size=1, max_size=min(len(wires), 4)))
        return lambda a, x: qml.PauliRot(angles(a, x)[0], word, wires=wires[: len(word)])
    count = GATES[name].wires or draw(st.integers(1, len(wires)))
    return lambda a, x: getattr(qml, name)(*angles(a, x)[: GATES[name].angles], wires=wires[:count])


def measurement(kind: str, word: str, wires: list[int], a: Tensor) -> Any:
    if kind == "state":
        return qml.state()
    if kind == "probs":
        return qml.probs(wires=wires[: len(word)])
    product = qml.prod(*(getattr(qml, letter)(wire) for letter, wire in zip(word, wires, strict=False)))
    if kind == "hamiltonian":
        return qml.expval(qml.dot([a[3], -1.6, 0.7], [product, qml.X(wires[0]), qml.I(wires[0])]))
    return {"expval": qml.expval, "var": qml.var}[kind](product)


def results(layer: Callable[..., nn.Module], script: Script, device: Any, batch: tuple[int, ...]) -> Any:
    """Outputs, and gradients of the weights and of the inputs; or the type of the error, as PennyLane has its own."""
    torch.manual_seed(11)
    node = qml.QNode(lambda inputs, a: script(a, inputs), device)
    module = layer(node, {"a": (20,)}, init_method=nn.init.normal_).double()
    x = torch.randn(*batch, 20, dtype=torch.float64).requires_grad_()
    try:
        values = module(x)
    except Exception as error:
        return type(error)
    gradients = [torch.zeros_like(tensor) for tensor in (module.a, x)]
    if values.requires_grad:
        total = (values * torch.arange(1, 1 + values.numel()).reshape(values.shape)).sum()
        found = torch.autograd.grad(total, (module.a, x), allow_unused=True)
        gradients = [zero if one is None else one for zero, one in zip(gradients, found, strict=True)]
    return [values.detach(), *gradients]


@pytest.mark.filterwarnings("ignore:from_qnode runs", "ignore:Casting complex values")
@settings(max_examples=2000 if LONG else 100)
@given(drawn=scripts(), batch=st.sampled_from([(), (3,), (1,), (2, 2)]))
def test_random_qnodes_equal_default_qubit(drawn: tuple[int, Script], batch: tuple[int, ...]) -> None:
    n, script = drawn
    expected = results(qml.qnn.TorchLayer, script, qml.device("default.qubit", wires=n), batch)
    assume(expected is not TypeError)  # a QNode without tensors: TorchLayer gets arrays of NumPy, and fails
    for own in (
        results(qml.qnn.TorchLayer, script, FastDevice(wires=n), batch),
        results(from_qnode, script, qml.device("default.qubit", wires=n), batch),
    ):
        if isinstance(expected, type):
            assert own is expected
            continue
        for one, two in zip(own, expected, strict=True):
            torch.testing.assert_close(one, two, rtol=1e-11, atol=1e-11, check_dtype=True)


def test_device_is_found_by_its_name() -> None:
    found = {entry.name: entry.value for entry in entry_points(group="pennylane.plugins")}
    if "qnerf.fast" not in found:
        pytest.skip("the package was installed before it had the device")
    assert isinstance(qml.device("qnerf.fast", wires=2), FastDevice)


def test_device_differentiates_other_interfaces_by_parameter_shift() -> None:
    def script(angle: Any) -> Any:
        qml.RX(angle, wires="a")
        qml.CNOT(["a", "b"])
        return qml.expval(qml.Z("b"))

    angle = qml.numpy.array(0.4, requires_grad=True)
    node = qml.QNode(script, FastDevice(wires=["a", "b"]))
    assert np.isclose(node(angle), np.cos(0.4))
    assert np.isclose(qml.grad(node)(angle), -np.sin(0.4))


@pytest.mark.parametrize("method", ["adjoint", "device", "best"])
def test_device_takes_the_gradient_methods_of_other_simulators(method: str) -> None:
    node = qml.QNode(lambda x: qml.RX(x, wires=0) and qml.expval(qml.Z(0)), FastDevice(wires=1), diff_method=method)
    x = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)
    node(x).backward()
    assert x.grad is not None
    assert np.isclose(x.grad, -np.sin(0.4))
    assert np.isclose(qml.grad(node)(qml.numpy.array(0.4, requires_grad=True)), -np.sin(0.4))


def test_device_computes_float32_parameters_in_float32() -> None:
    node = qml.QNode(lambda x: qml.RX(x, wires=0) and qml.expval(qml.Z(0)), FastDevice(wires=1))
    x = torch.linspace(0, 3, 7)
    assert node(x).dtype == torch.float64
    assert 0 < (node(x) - x.double().cos()).abs().max() < 1e-6
    assert (node(x.double()) - x.double().cos()).abs().max() < 1e-15


@pytest.mark.parametrize(
    ("shots", "measure"),
    [
        (20, lambda: qml.counts(wires=[0, 1])),
        (20, lambda: qml.expval(qml.Z(1))),
        (None, lambda: qml.probs(op=qml.X(1))),
    ],
)
def test_device_simulates_what_no_engine_takes(shots: int | None, measure: Callable[[], Any]) -> None:
    def script(angle: Any) -> Any:
        qml.RX(angle, wires=0)
        qml.cond(qml.measure(0), qml.X)(1)
        return measure()

    values = []
    for device in (FastDevice(wires=3, seed=7), qml.device("default.qubit", wires=3, seed=7)):
        node = qml.set_shots(qml.QNode(script, device), shots)
        with qml.Tracker(device) as tracker:
            values.append((node(0.5), tracker.totals))
    assert repr(values[0]) == repr(values[1])


@pytest.mark.parametrize(
    ("operation", "message"),
    [
        (lambda: qml.Beamsplitter(0.1, 0.2, wires=[0, 1]), "Beamsplitter.* not supported with qnerf.fast"),
        (lambda: qml.DepolarizingChannel(0.1, wires=0), "DepolarizingChannel.* not supported with qnerf.fast"),
        (lambda: qml.X(2), "Cannot run circuit"),
    ],
)
def test_device_refuses_what_default_qubit_refuses(operation: Callable[[], Any], message: str) -> None:
    node = qml.QNode(lambda: operation() and qml.expval(qml.Z(0)), FastDevice(wires=2))
    with pytest.raises((DeviceError, WireError), match=message):
        node()


def test_device_refuses_a_state_that_does_not_fit_into_memory() -> None:
    node = qml.QNode(lambda: qml.X(0) and qml.state(), FastDevice(wires=50))
    with pytest.raises(ValueError, match=r"a state as of default\.qubit would take"):
        node()


def test_device_passes_the_suite_of_pennylane(tmp_path: Path) -> None:
    """Of its gates, templates and wires only in long runs: random QNodes have them."""
    pytest.importorskip("pytest_mock")
    pytest.importorskip("flaky")
    suite = Path(qml.__file__).parent / "devices" / "tests"
    parts = ("gradients_torch", "gradients_autograd", "measurements", "return_system", "tracker", "properties")
    chosen = [suite] if LONG else [suite / f"test_{part}.py" for part in parts]
    options = ["--device=qnerf.fast", "--shots=None", "-q", "--no-flaky-report", "-p", "no:cacheprovider"]
    command = [sys.executable, "-m", "pytest", *chosen, *options]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    passed = re.search(r"^(\d+) passed", run.stdout, re.MULTILINE)
    assert run.returncode == 0, run.stdout + run.stderr
    assert passed is not None
    assert int(passed[1]) > 60


class Axis(qml.operation.Operation):
    """An operation whose decomposition reads an attribute."""

    num_wires, num_params, ndim_params = 1, 1, (0,)

    def __init__(self, x: Any, wires: Any, axis: str = "X", id: Any = None) -> None:
        self.axis = axis
        super().__init__(x, wires=wires, id=id)

    def decomposition(self) -> list[Any]:
        return [(qml.RX if self.axis == "X" else qml.RY)(self.data[0], wires=self.wires)]


class U3(qml.operation.Operation):
    """An operation with the name of a gate, in another convention."""

    num_wires, num_params, ndim_params = 1, 3, (0, 0, 0)

    @staticmethod
    def compute_decomposition(*angles: Any, wires: Any) -> list[Any]:  # type: ignore[override]
        return [gate(angle, wires) for gate, angle in zip((qml.RX, qml.RY, qml.RZ), angles, strict=True)]


ROUNDED = np.linalg.qr(np.random.RandomState(0).randn(4, 4))[0].round(4)  # not quite a unitary
SPECIAL: dict[str, Callable[[Any], Any]] = {
    "two controls": lambda w: qml.ctrl(qml.RX(w[0], wires=0), control=[1, 2]),
    "a controlled phase": lambda w: qml.ctrl(qml.PhaseShift(w[0], wires=0), control=[1, 2]),
    "a control of a control": lambda w: qml.ctrl(qml.CRX(w[0], wires=[0, 1]), control=2),
    "a controlled gate of three angles": lambda w: qml.ctrl(qml.U3(*w, wires=0), control=1),
    "a matrix of weights": lambda w: qml.QubitUnitary(
        torch.matrix_exp(1j * w[0] * torch.tensor([[0, 1], [1, 0]], dtype=torch.complex128)), wires=0
    ),
    "a rounded matrix": lambda w: (qml.QubitUnitary(ROUNDED, wires=[0, 1]), qml.RX(w[0], wires=0)),
    "an attribute": lambda w: Axis(w[0], wires=0, axis="Y"),
    "the name of a gate": lambda w: U3(*w, wires=0),
    "wires out of order": lambda w: (qml.RX(w[0], wires=2), qml.CNOT(wires=[2, 0])),
}


def encoded(queue: Callable[[Any], Any]) -> Callable[..., Any]:
    def circuit(inputs: Any, w: Any) -> list[Any]:
        qml.AngleEmbedding(inputs, wires=range(3), rotation="Y")
        qml.AngleEmbedding(1.3 * inputs, wires=range(3))
        queue(w)
        return [qml.expval(qml.X(0)), qml.expval(qml.Y(0) @ qml.Z(2)), qml.expval(qml.Y(1))]

    return circuit


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (2 * np.pi, 1e-9, 0.0), (0.3, 0.4, 0.5)], ids=str)
@pytest.mark.filterwarnings("ignore:from_qnode runs")
def test_operations_at_special_numbers_are_those_of_default_qubit(angles: tuple[float, ...]) -> None:
    """Values and gradients of what has no decomposition on expressions, or none that may be trusted."""
    x = torch.rand(3, 3, dtype=torch.float64)
    for name, queue in SPECIAL.items():
        found = []
        for make in (qml.qnn.TorchLayer, from_qnode):
            layer = make(qml.QNode(encoded(queue), qml.device("default.qubit", wires=3)), {"w": (3,)}).double()
            layer.w.data = torch.tensor(angles, dtype=torch.float64)
            (out := layer(x)).sum().backward()
            found.append((out.detach(), layer.w.grad))
        for one, two in zip(*found, strict=True):
            torch.testing.assert_close(one, two, rtol=0, atol=1e-8 if angles[1] == 1e-9 else 1e-12, msg=name)


def test_probabilities_without_wires_have_the_order_of_pennylane() -> None:
    def circuit(inputs: Any, w: Any) -> Any:
        qml.RY(inputs[..., 0], wires=1)
        qml.RX(w[0], wires=0)
        return qml.probs()

    x = torch.rand(3, 1, dtype=torch.float64)
    ours, theirs = (make(qml.QNode(circuit, qml.device("default.qubit")), {"w": (1,)}).double()
                    for make in (from_qnode, qml.qnn.TorchLayer))  # fmt: skip
    theirs.load_state_dict(ours.state_dict())
    torch.testing.assert_close(ours(x), theirs(x), rtol=0, atol=1e-12)


@pytest.mark.filterwarnings("ignore:from_qnode runs")
def test_transformed_and_own_devices_are_not_taken_for_their_base() -> None:
    class Damped(qml.devices.DefaultQubit):
        pass

    def circuit(inputs: Any) -> Any:
        qml.RX(inputs[..., 0], wires=0)
        return qml.expval(qml.Z(0))

    for device in (Damped(wires=1), qml.noise.insert(qml.device("default.qubit", wires=1), qml.RX, 0.3)):
        node = qml.QNode(circuit, device)
        x = torch.rand(2, 1, dtype=torch.float64)
        layer = from_qnode(node, {})
        torch.testing.assert_close(layer(x), qml.qnn.TorchLayer(node, {})(x))
        assert layer.runs_on.startswith("default.qubit")


def test_a_transform_of_the_device_sees_the_same_operations_on_fast_as_on_default_qubit() -> None:
    @qml.transform
    def overrotated(tape: Any) -> Any:
        turned = [type(own)(1.1 * own.data[0], own.wires) if own.name == "RX" else own for own in tape.operations]
        return [tape.copy(operations=turned)], lambda results: results[0]

    def circuit(x: Any) -> Any:
        qml.AngleEmbedding(x, wires=range(2))
        return qml.expval(qml.Z(0))

    x = torch.tensor([0.4, 0.8], dtype=torch.float64)
    own, expected = (
        qml.QNode(circuit, overrotated(qml.device(name, wires=2)))(x) for name in ("qnerf.fast", "default.qubit")
    )
    torch.testing.assert_close(own, expected)
