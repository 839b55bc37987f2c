"""`qnerf.fast` and `from_qnode` against `default.qubit` on random QNodes, and what else scripts for PennyLane meet."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pennylane as qml
import pytest
import torch
from pennylane.exceptions import DeviceError, WireError

from qnerf.quantum import from_qnode
from qnerf.quantum.pennylane_device import FastDevice
from tests.helpers.circuits import CHUNKS, derivatives
from tests.helpers.scripts import NUMBERS, random_script

BATCHES = [(), (3,), (1,), (2, 2)]
LONG = os.environ.get("QNERF_HYPOTHESIS") == "long"


def results(layer, script, device, number):
    """Outputs, first and second derivatives; or the type of the error, as PennyLane has its own."""
    torch.manual_seed(number)
    module = layer(qml.QNode(script.function, device), {"a": (NUMBERS,)}).double()
    module.a.data = script.weights.clone()
    x = torch.randn(*BATCHES[number % 4], NUMBERS, dtype=torch.float64).requires_grad_()
    try:
        y = module(x)
    except Exception as error:
        return type(error)
    return [y.detach(), *([] if y.is_complex() else derivatives(y, module.a, x))]


@pytest.mark.filterwarnings("ignore:from_qnode runs", "ignore:Casting complex values")
@pytest.mark.parametrize("numbers", CHUNKS, ids=str)
def test_random_qnodes_equal_default_qubit(numbers):
    for number in numbers:
        script = random_script(number)
        wires = script.labels if number % 3 else None
        expected = results(qml.qnn.TorchLayer, script, qml.device("default.qubit", wires=wires), number)
        for own in (
            results(qml.qnn.TorchLayer, script, FastDevice(wires=wires), number),
            results(from_qnode, script, qml.device("default.qubit", wires=wires), number),
        ):
            if isinstance(expected, type):
                assert own is expected, number
                continue
            for one, two in zip(own, expected, strict=True):
                scale = two.abs().max().clamp(min=1).item() if two.numel() else 1
                torch.testing.assert_close(one, two, rtol=0, atol=1e-12 * scale, msg=f"number {number}")


@pytest.mark.parametrize("method", ["adjoint", "device", "best"])
def test_device_takes_the_gradient_methods_of_other_simulators(method):
    node = qml.QNode(lambda x: qml.RX(x, wires=0) and qml.expval(qml.Z(0)), FastDevice(wires=1), diff_method=method)
    x = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)
    node(x).backward()
    assert np.isclose(x.grad, -np.sin(0.4))
    assert np.isclose(qml.grad(node)(qml.numpy.array(0.4, requires_grad=True)), -np.sin(0.4))


def test_device_computes_float32_parameters_in_float32():
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
def test_device_simulates_what_no_engine_takes(shots, measure):
    def script(angle):
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
def test_device_refuses_what_default_qubit_refuses(operation, message):
    node = qml.QNode(lambda: operation() and qml.expval(qml.Z(0)), FastDevice(wires=2))
    with pytest.raises((DeviceError, WireError), match=message):
        node()


def test_device_refuses_a_state_that_does_not_fit_into_memory():
    node = qml.QNode(lambda: qml.X(0) and qml.state(), FastDevice(wires=50))
    with pytest.raises(ValueError, match=r"a state as of default\.qubit would take"):
        node()


def test_device_passes_the_suite_of_pennylane(tmp_path):
    """Of its gates, templates and wires only in long runs: random QNodes have them."""
    suite = Path(qml.__file__).parent / "devices" / "tests"
    parts = ("gradients_torch", "gradients_autograd", "measurements", "return_system", "tracker", "properties")
    chosen = [suite] if LONG else [suite / f"test_{part}.py" for part in parts]
    options = ["--device=qnerf.fast", "--shots=None", "-q", "--no-flaky-report", "-p", "no:cacheprovider"]
    command = [sys.executable, "-m", "pytest", *chosen, *options]
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    passed = re.search(r"^(\d+) passed", run.stdout, re.MULTILINE)
    assert run.returncode == 0, run.stdout + run.stderr
    assert int(passed[1]) > 60


@pytest.mark.filterwarnings("ignore:from_qnode runs")
def test_transformed_and_own_devices_are_not_taken_for_their_base():
    class Damped(qml.devices.DefaultQubit):
        pass

    def circuit(inputs):
        qml.RX(inputs[..., 0], wires=0)
        return qml.expval(qml.Z(0))

    for device in (Damped(wires=1), qml.noise.insert(qml.device("default.qubit", wires=1), qml.RX, 0.3)):
        node = qml.QNode(circuit, device)
        x = torch.rand(2, 1, dtype=torch.float64)
        layer = from_qnode(node, {})
        torch.testing.assert_close(layer(x), qml.qnn.TorchLayer(node, {})(x))
        assert layer.runs_on.startswith("default.qubit")


def test_a_transform_of_the_device_sees_the_same_operations_on_fast_as_on_default_qubit():
    @qml.transform
    def overrotated(tape):
        turned = [type(own)(1.1 * own.data[0], own.wires) if own.name == "RX" else own for own in tape.operations]
        return [tape.copy(operations=turned)], lambda results: results[0]

    def circuit(x):
        qml.AngleEmbedding(x, wires=range(2))
        return qml.expval(qml.Z(0))

    x = torch.tensor([0.4, 0.8], dtype=torch.float64)
    own, expected = (
        qml.QNode(circuit, overrotated(qml.device(name, wires=2)))(x) for name in ("qnerf.fast", "default.qubit")
    )
    torch.testing.assert_close(own, expected)
