"""Every engine against every other and PennyLane, outputs and derivatives."""

import sys
from contextlib import suppress
from math import pi
from random import Random

import pytest
import torch

from qnerf.quantum import lightcone
from qnerf.quantum.circuit import ANSATZE, Circuit, Gate, Weights, feature
from qnerf.quantum.compiled import engine as compiled
from qnerf.quantum.compiled.engine import Engine
from qnerf.quantum.cones import find_cones
from qnerf.quantum.pennylane import make_node
from qnerf.quantum.program import program
from qnerf.quantum.statevector import PlainCircuit
from tests.helpers.circuits import CHUNKS, SPECIAL, derivatives, random_circuit


def torch_engine(circuit):
    return PlainCircuit(circuit).evaluate


def compiled_engine(circuit):
    return Engine(circuit).evaluate


def through_cones(circuit, compiled):
    own, cones = Engine(circuit), lightcone.LightCones(find_cones(program(circuit)))
    simulate = own.simulate if compiled else own.plain.simulate
    return lambda x, w: cones.evaluate(own.plain, simulate, x, w, compiled)


def cone_engine(circuit):
    return through_cones(circuit, True)


def cone_reference(circuit):
    return through_cones(circuit, False)


def data(circuit, batch, seed=7):
    """Inputs (B, n) and flat weights over several turns, float64."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(batch, circuit.features or 0, generator=generator, dtype=torch.float64) * 2
    return x, torch.randn(circuit.size, generator=generator, dtype=torch.float64) * 4


def results(function, circuit, batch=5, dtype=torch.float64):
    """Outputs, and gradients of inputs and weights."""
    x, w = (tensor.to(dtype).requires_grad_() for tensor in data(circuit, batch))
    y = function(x, w)
    g = torch.randn(y.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    dx, dw = torch.autograd.grad(y, (x, w), g.to(dtype), allow_unused=True)
    return [y.detach(), *(torch.zeros(()) if d is None else d for d in (dx, dw))]


def assert_same(a, b, output, gradient):
    assert (a[0].double() - b[0].double()).abs().max() <= output
    for one, two in zip(a[1:], b[1:], strict=True):
        scale = two.abs().max().clamp(min=1).double()
        assert (one.double() - two.double()).abs().max() <= gradient * scale


@pytest.mark.parametrize("numbers", CHUNKS, ids=str)
def test_engines_agree_on_random_circuits_and_equal_pennylane(numbers):
    """Values, first and second derivatives."""
    for number in numbers:
        circuit = random_circuit(number)
        x, w = (tensor.requires_grad_() for tensor in data(circuit, 3, seed=number))
        compiled = Engine(circuit)
        engines = {"compiled": compiled.evaluate, "torch": compiled.plain.evaluate, "pennylane": make_node(circuit)}
        with suppress(lightcone.TooLarge):
            if len(lightcone.interpolation(find_cones(program(circuit))).points) <= 3000:
                engines |= {"cones": cone_engine(circuit), "plain cones": cone_reference(circuit)}
        tolerances = {"cones": 1e-10, "plain cones": 1e-10}  # an interpolation at up to 3,000 points
        if "1e-09" in str(circuit.operations):
            tolerances["pennylane"] = 1e-8  # some of its gates leave out such an angle
        found = {name: (y := engine(x, w), *derivatives(y, x, w)) for name, engine in engines.items()}
        for name, own in found.items():
            for one, two in zip(own, found["torch"], strict=True):
                error = (one - two).abs().max() / two.abs().max().clamp(min=1)
                assert error <= tolerances.get(name, 1e-12), (number, name)


@pytest.fixture
def products(monkeypatch):
    """Programs with products of rotations whatever the number of wires."""
    monkeypatch.setattr(sys.modules[program.__module__], "PRODUCT_WIRES", 0)
    program.cache_clear()
    yield
    program.cache_clear()


@pytest.mark.usefixtures("products")
def test_products_of_rotations_of_random_circuits_equal_pennylane():
    test_engines_agree_on_random_circuits_and_equal_pennylane(range(50))


@pytest.mark.usefixtures("products")
def test_products_of_rotations_have_all_derivatives_at_special_angles():
    """Angles of Euler have none where the middle one is a multiple of pi."""
    w = Weights("w", (2, 3))
    layers = [
        [Gate(f"R{axis}", wire, w[wire, k]) for wire in range(2) for k, axis in enumerate(axes)]
        for axes in ("XZX", "YXZ")
    ]
    gates = [*layers[0], Gate("CNOT", (0, 1)), Gate("RX", 0, feature(0)), *layers[1], Gate("CZ", (0, 1)), *layers[0]]
    circuit = Circuit("products", 2, gates, (((0, "Z"),), ((0, "X"), (1, "Y"))), weights=w)
    random = Random(0)
    for number in range(60):
        x = torch.tensor([[0.7], [0.0]], dtype=torch.float64, requires_grad=True)
        angles = [random.choice([0.0, pi, random.choice(SPECIAL), 1e-9, 1e-160]) for _ in range(circuit.size)]
        weights = torch.tensor(angles, dtype=torch.float64, requires_grad=True)
        own, plain = (
            (y := engine(x, weights), *derivatives(y, x, weights))
            for engine in (Engine(circuit).evaluate, make_node(circuit))
        )
        for one, two in zip(own, plain, strict=True):
            assert (one - two).abs().max() <= 1e-12, (number, angles)


def test_named_circuits_equal_pennylane_with_their_gradients():
    shapes = ((1, 1), (1, 6), (2, 2), (3, 1), (5, 6), (9, 2), (12, 1))
    named = [ANSATZE.build(name, 4, 2) for name in ANSATZE.names()]
    for circuit in (*(ANSATZE.build("qiren", *shape) for shape in shapes), *named):
        expected = results(make_node(circuit), circuit, batch=3)
        rotations_of_x = sum("x[0]" in str(gate.angles) for gate in circuit.gates)
        engines = [compiled_engine(circuit), *([cone_engine(circuit)] if rotations_of_x == 1 else [])]
        for engine in engines:
            assert_same(results(engine, circuit, batch=3), expected, 1e-12, 1e-12)
            assert_same(results(engine, circuit, batch=3, dtype=torch.float32), expected, 2e-6, 1e-5)
        assert_same(results(torch_engine(circuit), circuit, batch=3), expected, 1e-12, 1e-12)


def test_engines_take_many_blocks_of_samples():
    """Each part of the batch that is summed on its own holds several blocks."""
    for wires, spectral in ((1, 2), (4, 2), (6, 1), (8, 2)):
        circuit = ANSATZE.build("qiren", wires, spectral)
        expected = results(torch_engine(circuit), circuit, batch=700)
        assert_same(results(compiled_engine(circuit), circuit, batch=700), expected, 1e-12, 1e-12)
        if spectral == 1:
            assert_same(results(cone_engine(circuit), circuit, batch=700), expected, 1e-12, 1e-12)


def test_states_that_are_not_stored_have_the_same_gradients(monkeypatch):
    for name in ("qiren", "cnot", "rx"):
        circuit = ANSATZE.build(name, 4, 2)
        expected = results(compiled_engine(circuit), circuit, batch=37)
        with monkeypatch.context() as patch:
            patch.setattr(compiled, "STORED_BYTES", 0)
            assert_same(results(compiled_engine(circuit), circuit, batch=37), expected, 1e-13, 1e-12)


def test_nan_in_a_cone_stays_in_the_cone():
    circuit = ANSATZE.build("qiren", 8, 1)
    x, w = data(circuit, 1)
    x[0, 2] = float("nan")
    assert cone_engine(circuit)(x, w)[0].isnan().nonzero().flatten().tolist() == [1, 2, 3]


def test_empty_batches_have_zero_gradients():
    for name in ANSATZE.names():
        circuit = ANSATZE.build(name, 3, 1)
        for engine in (torch_engine, compiled_engine, cone_engine, cone_reference):
            x = torch.zeros(0, 3, dtype=torch.float64, requires_grad=True)
            w = torch.ones(circuit.size, dtype=torch.float64, requires_grad=True)
            y = engine(circuit)(x, w)
            y.sum().backward()
            assert y.shape == (0, 3)
            assert w.grad is not None
            assert not w.grad.any()
