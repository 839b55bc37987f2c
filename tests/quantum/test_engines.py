"""Every engine against every other on random descriptions, and gradients by finite differences."""

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from qnerf.quantum import lightcone, statevector
from qnerf.quantum.circuit import ANSATZE, Circuit, Encoding, Entangler, Operation, Rotations
from qnerf.quantum.compiled import engine as compiled
from qnerf.quantum.normal_form import normal_form
from qnerf.quantum.pennylane import make_node

Function = Callable[[Tensor, Tensor], Tensor]


def torch_engine(circuit: Circuit) -> Function:
    form = normal_form(circuit)
    return lambda x, w: statevector.evaluate(form, x, w)


def compiled_engine(circuit: Circuit) -> Function:
    engine = compiled.StatevectorEngine(normal_form(circuit))
    return lambda x, w: compiled.evaluate(engine, x, w)


def cone_engine(circuit: Circuit) -> Function:
    cone = lightcone.LightConeEngine(circuit)
    return lambda x, w: lightcone.evaluate(cone, x, w)


def cone_reference(circuit: Circuit) -> Function:
    return lambda x, w: lightcone.evaluate_reference(circuit, x, w)


def reference(circuit: Circuit) -> Function:
    node = make_node(circuit)
    return lambda x, w: node(x, w.flatten())


def results(function: Function, circuit: Circuit, batch: int = 5, dtype: torch.dtype = torch.float64) -> list[Tensor]:
    """Outputs, and gradients of inputs and weights, for inputs and angles over several turns."""
    generator = torch.Generator().manual_seed(7)
    x = torch.randn(batch, circuit.wires, generator=generator, dtype=torch.float64) * 2
    w = torch.randn(circuit.rows, circuit.wires, 3, generator=generator, dtype=torch.float64) * 4
    g = torch.randn(batch, len(circuit.observables), generator=generator, dtype=torch.float64)
    x, w = x.to(dtype).requires_grad_(), w.to(dtype).requires_grad_()
    y = function(x, w)
    dx, dw = torch.autograd.grad(y, (x, w), g.to(dtype), allow_unused=True)
    return [y.detach(), *(torch.zeros(()) if d is None else d for d in (dx, dw))]


def assert_same(a: list[Tensor], b: list[Tensor], output: float, gradient: float) -> None:
    assert (a[0].double() - b[0].double()).abs().max() <= output
    for one, two in zip(a[1:], b[1:], strict=True):
        scale = two.abs().max().clamp(min=1).double()
        assert (one.double() - two.double()).abs().max() <= gradient * scale


@st.composite
def circuits(draw: st.DrawFn, wires: int = 5) -> Circuit:
    """Any order of rotations, CZ and CNOT on any pairs, encodings about any axis, and Pauli words."""
    n = draw(st.integers(1, wires))
    sublayers, spectral = draw(st.integers(1, 2)), draw(st.integers(1, 2))
    pairs = st.tuples(st.integers(0, n - 1), st.integers(0, n - 1)).filter(lambda pair: pair[0] != pair[1])
    operations: list[Operation] = []
    for row in range(sublayers * (spectral + 1)):
        if draw(st.booleans()) or row == 0:
            operations.append(Rotations(row))
        if n > 1:
            gate = draw(st.sampled_from(["CZ", "CNOT"]))
            operations.append(Entangler(gate, tuple(draw(st.lists(pairs, max_size=4)))))
        if draw(st.booleans()):
            scales = draw(st.lists(st.sampled_from([0.0, 0.5, 1.0, -1.0, 3.0]), min_size=n, max_size=n))
            operations.append(Encoding(draw(st.sampled_from("XYZ")), tuple(scales)))
    letters = [draw(st.sampled_from("XYZ")) for _ in range(n)]
    words = []
    for _ in range(draw(st.integers(1, n))):
        chosen = draw(st.sets(st.integers(0, n - 1), min_size=1, max_size=2))
        words.append(tuple((wire, letters[wire]) for wire in sorted(chosen)))
    return Circuit("random", n, spectral, sublayers, tuple(operations), tuple(words))


@settings(max_examples=60)
@given(circuit=circuits())
def test_engines_agree_on_random_descriptions(circuit: Circuit) -> None:
    expected = results(torch_engine(circuit), circuit)
    assert_same(results(compiled_engine(circuit), circuit), expected, 1e-12, 1e-11)
    try:
        lightcone.interpolation(circuit)
    except ValueError as error:
        assert "lightcone" in str(error)  # noqa: PT017
        return
    if len(lightcone.interpolation(circuit).points) <= 3000:
        assert_same(results(cone_engine(circuit), circuit), expected, 1e-11, 1e-10)
        assert_same(results(cone_reference(circuit), circuit), expected, 1e-11, 1e-10)


@settings(max_examples=15)
@given(circuit=circuits(wires=4))
def test_random_descriptions_agree_with_pennylane(circuit: Circuit) -> None:
    # Only outputs: PennyLane has no gradient where nothing depends on the input.
    generator = torch.Generator().manual_seed(1)
    x = torch.randn(3, circuit.wires, generator=generator, dtype=torch.float64)
    w = torch.randn(circuit.rows, circuit.wires, 3, generator=generator, dtype=torch.float64) * 3
    error = (reference(circuit)(x, w) - compiled_engine(circuit)(x, w)).abs().max()
    assert error <= 1e-12


@pytest.mark.parametrize(("wires", "spectral"), [(1, 1), (1, 6), (2, 2), (3, 1), (3, 4), (5, 6), (9, 2), (12, 1)])
def test_qiren_equals_pennylane(wires: int, spectral: int) -> None:
    circuit = ANSATZE.build("qiren", wires, spectral)
    expected = results(reference(circuit), circuit, batch=3)
    assert_same(results(compiled_engine(circuit), circuit, batch=3), expected, 1e-12, 1e-12)
    assert_same(results(torch_engine(circuit), circuit, batch=3), expected, 1e-12, 1e-12)
    single = results(compiled_engine(circuit), circuit, batch=3, dtype=torch.float32)
    assert_same(single, expected, 2e-6, 1e-5)
    if spectral == 1:
        assert_same(results(cone_engine(circuit), circuit, batch=3), expected, 1e-12, 1e-12)
        single = results(cone_engine(circuit), circuit, batch=3, dtype=torch.float32)
        assert_same(single, expected, 2e-6, 1e-5)


@pytest.mark.parametrize("name", ANSATZE.names())
def test_every_ansatz_equals_pennylane(name: str) -> None:
    circuit = ANSATZE.build(name, 4, 2)
    expected = results(reference(circuit), circuit)
    assert_same(results(compiled_engine(circuit), circuit), expected, 1e-12, 1e-12)


@pytest.mark.parametrize("engine", [torch_engine, compiled_engine, cone_engine, cone_reference])
@pytest.mark.parametrize(("wires", "spectral", "name"), [(1, 2, "qiren"), (4, 1, "qiren"), (3, 1, "ry")])
def test_gradcheck(engine: Callable[[Circuit], Function], wires: int, spectral: int, name: str) -> None:
    circuit = ANSATZE.build(name, wires, spectral)
    generator = torch.Generator().manual_seed(3)
    x = torch.randn(2, wires, generator=generator, dtype=torch.float64, requires_grad=True)
    w = torch.randn(circuit.rows, wires, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(engine(circuit), (x, w))


@pytest.mark.parametrize("engine", [torch_engine, compiled_engine, cone_engine, cone_reference])
def test_every_engine_is_differentiable_twice(engine: Callable[[Circuit], Function]) -> None:
    circuit = ANSATZE.build("qiren", 2, 1)
    x = torch.randn(2, 2, dtype=torch.float64, requires_grad=True)
    w = torch.randn(circuit.rows, 2, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradgradcheck(engine(circuit), (x, w))


@pytest.mark.parametrize("engine", [compiled_engine, cone_engine])
def test_a_loss_of_derivatives_trains_as_with_plain_torch(engine: Callable[[Circuit], Function]) -> None:
    """As in a physics-informed network: du/dx enters the loss, which is differentiated by the weights."""
    circuit = ANSATZE.build("qiren", 4, 1)
    generator = torch.Generator().manual_seed(5)
    x = torch.randn(16, 4, generator=generator, dtype=torch.float64, requires_grad=True)
    w = torch.randn(circuit.rows, 4, 3, generator=generator, dtype=torch.float64, requires_grad=True)

    def gradient(evaluate: Function) -> torch.Tensor:
        u = evaluate(x, w).sum(-1)
        (slope,) = torch.autograd.grad(u.sum(), x, create_graph=True)
        assert slope.requires_grad
        (second,) = torch.autograd.grad(slope[:, 1].sum(), x, create_graph=True)
        loss = (u - 1).square().mean() + (second[:, 1] + slope[:, 0] + u).square().mean()
        return torch.autograd.grad(loss, w)[0]

    torch.testing.assert_close(gradient(engine(circuit)), gradient(torch_engine(circuit)), rtol=1e-10, atol=1e-12)


def test_only_the_weights_may_need_second_derivatives() -> None:
    circuit = ANSATZE.build("qiren", 3, 2)
    x = torch.randn(4, 3, dtype=torch.float64)
    w = torch.randn(circuit.rows, 3, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradgradcheck(lambda weights: compiled_engine(circuit)(x, weights), (w,))


@pytest.mark.parametrize(("wires", "spectral"), [(1, 2), (3, 1), (4, 2), (6, 1), (8, 2)])
def test_many_blocks_of_samples(wires: int, spectral: int) -> None:
    """Each part of the batch that is summed on its own holds several blocks."""
    circuit = ANSATZE.build("qiren", wires, spectral)
    expected = results(torch_engine(circuit), circuit, batch=700)
    assert_same(results(compiled_engine(circuit), circuit, batch=700), expected, 1e-12, 1e-12)
    if spectral == 1:
        assert_same(results(cone_engine(circuit), circuit, batch=700), expected, 1e-12, 1e-12)


@pytest.mark.parametrize("engine", [compiled_engine, cone_engine])
def test_results_do_not_depend_on_threads(engine: Callable[[Circuit], Function]) -> None:
    circuit = ANSATZE.build("qiren", 3, 2)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = results(engine(circuit), circuit, batch=1001, dtype=torch.float32)
        torch.set_num_threads(2)
        two = results(engine(circuit), circuit, batch=1001, dtype=torch.float32)
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for a, b in zip(one, two, strict=True))


def test_samples_do_not_depend_on_their_neighbours() -> None:
    circuit = ANSATZE.build("qiren", 4, 2)
    x = torch.randn(40, 4, generator=torch.Generator().manual_seed(0))
    x[3], x[20] = float("nan"), float("inf")
    w = torch.randn(circuit.rows, 4, 3, generator=torch.Generator().manual_seed(1))
    y = compiled_engine(circuit)(x, w)
    bad = y.isnan().any(1)
    assert bad.nonzero().flatten().tolist() == [3, 20]
    assert torch.equal(compiled_engine(circuit)(x[4:20], w), y[4:20])


def test_nan_in_a_cone_stays_in_the_cone() -> None:
    circuit = ANSATZE.build("qiren", 8, 1)
    w = torch.randn(circuit.rows, 8, 3, generator=torch.Generator().manual_seed(1))
    x = torch.zeros(1, 8)
    x[0, 2] = float("nan")
    assert cone_engine(circuit)(x, w)[0].isnan().nonzero().flatten().tolist() == [1, 2, 3]


def test_chunks_of_plain_torch_are_seamless(monkeypatch: pytest.MonkeyPatch) -> None:
    circuit = ANSATZE.build("qiren", 3, 2)
    whole = results(torch_engine(circuit), circuit, batch=23)
    monkeypatch.setattr(statevector, "CHUNK_BYTES", 20_000)
    assert statevector.chunk_size(normal_form(circuit), 8) < 10
    assert_same(results(torch_engine(circuit), circuit, batch=23), whole, 1e-14, 1e-13)


@pytest.mark.parametrize("ansatz", ANSATZE.names())
@pytest.mark.parametrize("engine", [torch_engine, compiled_engine, cone_engine, cone_reference])
def test_an_empty_batch_has_zero_gradients(engine: Callable[[Circuit], Function], ansatz: str) -> None:
    circuit = ANSATZE.build(ansatz, 3, 1)
    x = torch.zeros(0, 3, dtype=torch.float64, requires_grad=True)
    w = torch.ones(circuit.rows, 3, 3, dtype=torch.float64, requires_grad=True)
    y = engine(circuit)(x, w)
    y.sum().backward()
    assert y.shape == (0, 3)
    assert w.grad is not None
    assert not w.grad.any()
