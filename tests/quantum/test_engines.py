"""Every engine of re-uploading circuits against every other and PennyLane, outputs and derivatives."""

from collections.abc import Callable
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from qnerf.quantum import lightcone, statevector
from qnerf.quantum.circuit import ANSATZE, Circuit, Gate, Weights, encoding, entanglers, rotations
from qnerf.quantum.compiled import engine as compiled
from qnerf.quantum.compiled.engine import Engine
from qnerf.quantum.cones import find_cones
from qnerf.quantum.pennylane import make_node
from qnerf.quantum.program import program
from qnerf.quantum.statevector import PlainCircuit

Function = Callable[[Tensor, Tensor], Tensor]


def torch_engine(circuit: Circuit) -> Function:
    return PlainCircuit(circuit).evaluate


def compiled_engine(circuit: Circuit) -> Function:
    return Engine(circuit).evaluate


def through_cones(circuit: Circuit, compiled: bool) -> Function:
    own, cones = Engine(circuit), lightcone.LightCones(find_cones(program(circuit)))
    simulate = own.simulate if compiled else own.plain.simulate
    return lambda x, w: cones.evaluate(own.plain, simulate, x, w, compiled)


def cone_engine(circuit: Circuit) -> Function:
    return through_cones(circuit, True)


def cone_reference(circuit: Circuit) -> Function:
    return through_cones(circuit, False)


def data(circuit: Circuit, batch: int, seed: int = 7) -> tuple[Tensor, Tensor]:
    """Inputs (B, n) and flat weights over several turns, float64."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(batch, circuit.features or 0, generator=generator, dtype=torch.float64) * 2
    return x, torch.randn(circuit.size, generator=generator, dtype=torch.float64) * 4


def results(function: Function, circuit: Circuit, batch: int = 5, dtype: torch.dtype = torch.float64) -> list[Tensor]:
    """Outputs, and gradients of inputs and weights."""
    x, w = (tensor.to(dtype).requires_grad_() for tensor in data(circuit, batch))
    y = function(x, w)
    g = torch.randn(y.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    dx, dw = torch.autograd.grad(y, (x, w), g.to(dtype), allow_unused=True)
    return [y.detach(), *(torch.zeros(()) if d is None else d for d in (dx, dw))]


def assert_same(a: list[Tensor], b: list[Tensor], output: float, gradient: float) -> None:
    assert (a[0].double() - b[0].double()).abs().max() <= output
    for one, two in zip(a[1:], b[1:], strict=True):
        scale = two.abs().max().clamp(min=1).double()
        assert (one.double() - two.double()).abs().max() <= gradient * scale


@st.composite
def circuits(draw: st.DrawFn, wires: int = 5) -> Circuit:
    """Any order of rotations, CZ and CNOT on any pairs, and encodings about any axis; Pauli words in one basis."""
    n, rows = draw(st.integers(1, wires)), draw(st.integers(1, 6))
    angles = Weights("w", (rows, n, 3))
    pairs = st.tuples(st.integers(0, n - 1), st.integers(0, n - 1)).filter(lambda pair: pair[0] != pair[1])
    operations: list[Gate] = []
    for row in range(rows):
        if draw(st.booleans()) or row == 0:
            operations += rotations(angles[row])
        if n > 1:
            operations += entanglers(draw(st.sampled_from(["CZ", "CNOT"])), draw(st.lists(pairs, max_size=4)))
        if draw(st.booleans()):
            scales = draw(st.lists(st.sampled_from([0.0, 0.5, 1.0, -1.0, 3.0]), min_size=n, max_size=n))
            operations += encoding(draw(st.sampled_from("XYZ")), scales)
    letters = [draw(st.sampled_from("XYZ")) for _ in range(n)]
    words = []
    for _ in range(draw(st.integers(1, n))):
        chosen = draw(st.sets(st.integers(0, n - 1), min_size=1, max_size=2))
        words.append(tuple((wire, letters[wire]) for wire in sorted(chosen)))
    return Circuit("random", n, tuple(operations), tuple(words), weights=(angles,))


@settings(max_examples=60)
@given(circuit=circuits())
def test_engines_agree_on_random_descriptions(circuit: Circuit) -> None:
    expected = results(torch_engine(circuit), circuit)
    assert_same(results(compiled_engine(circuit), circuit), expected, 1e-12, 1e-11)
    try:
        points = lightcone.interpolation(find_cones(program(circuit))).points
    except lightcone.TooLarge:
        return
    if len(points) <= 3000:
        assert_same(results(cone_engine(circuit), circuit), expected, 1e-11, 1e-10)
        assert_same(results(cone_reference(circuit), circuit), expected, 1e-11, 1e-10)


@settings(max_examples=15)
@given(circuit=circuits(wires=4))
def test_random_descriptions_agree_with_pennylane(circuit: Circuit) -> None:
    # Only outputs: PennyLane has no gradient where nothing depends on the input.
    x, w = data(circuit, 3)
    assert (make_node(circuit)(x, w) - compiled_engine(circuit)(x, w)).abs().max() <= 1e-12


def test_named_circuits_equal_pennylane_with_their_gradients() -> None:
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


def test_second_derivatives_are_those_of_differences() -> None:
    circuit = ANSATZE.build("qiren", 2, 1)
    x, w = (tensor.requires_grad_() for tensor in data(circuit, 2))
    for engine in (compiled_engine, cone_engine):
        function = engine(circuit)
        assert torch.autograd.gradgradcheck(function, (x, w))
        assert torch.autograd.gradgradcheck(partial(function, x.detach()), (w,))


def test_engines_take_many_blocks_of_samples() -> None:
    """Each part of the batch that is summed on its own holds several blocks."""
    for wires, spectral in ((1, 2), (4, 2), (6, 1), (8, 2)):
        circuit = ANSATZE.build("qiren", wires, spectral)
        expected = results(torch_engine(circuit), circuit, batch=700)
        assert_same(results(compiled_engine(circuit), circuit, batch=700), expected, 1e-12, 1e-12)
        if spectral == 1:
            assert_same(results(cone_engine(circuit), circuit, batch=700), expected, 1e-12, 1e-12)


def test_states_that_are_not_stored_have_the_same_gradients(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("qiren", "cnot", "rx"):
        circuit = ANSATZE.build(name, 4, 2)
        expected = results(compiled_engine(circuit), circuit, batch=37)
        with monkeypatch.context() as patch:
            patch.setattr(compiled, "STORED_BYTES", 0)
            assert_same(results(compiled_engine(circuit), circuit, batch=37), expected, 1e-13, 1e-12)


def test_nan_in_a_cone_stays_in_the_cone() -> None:
    circuit = ANSATZE.build("qiren", 8, 1)
    x, w = data(circuit, 1)
    x[0, 2] = float("nan")
    assert cone_engine(circuit)(x, w)[0].isnan().nonzero().flatten().tolist() == [1, 2, 3]


def test_chunks_of_plain_torch_are_seamless(monkeypatch: pytest.MonkeyPatch) -> None:
    circuit = ANSATZE.build("qiren", 3, 2)
    whole = results(torch_engine(circuit), circuit, batch=23)
    monkeypatch.setattr(statevector, "CHUNK_BYTES", 20_000)
    assert statevector.chunk_size(program(circuit), 8) < 10
    assert_same(results(torch_engine(circuit), circuit, batch=23), whole, 1e-14, 1e-13)


def test_empty_batches_have_zero_gradients() -> None:
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
