"""Circuits of all parts at once: their programs, batches and precisions, and what a wrong description says."""

from dataclasses import replace
from typing import Any

import numpy as np
import pennylane as qml
import pytest
import torch

from qnerf.quantum import statevector
from qnerf.quantum.blocks import CNOTs, Diagonal, RYLayer, rotations_of
from qnerf.quantum.circuit import (
    ANSATZE,
    Amplitudes,
    Circuit,
    Gate,
    Hamiltonian,
    Probabilities,
    Weights,
    encoding,
    entanglers,
    feature,
    weight,
)
from qnerf.quantum.layer import QuantumLayer
from qnerf.quantum.program import program

W = Weights("w", (2, 3))
FEATURES = 4
MIXED = Circuit(
    "mixed",
    wires=3,
    features=FEATURES,
    weights=(W, Weights("scale", (), initial=1.0)),
    operations=(
        Amplitudes((1,), (feature(3), W[0, 0]), (0.5, feature(0))),
        Gate("H", (0,)),
        Gate("CRX", (0, 2), (feature(2) * weight("scale", 0),)),
        Gate("IsingXY", (1, 2), (0.5 * feature(0) * feature(1) + W[0, 1],)),
        Gate("T", (0,)),
        Gate("Rot", (2,), (W[0, 2], W[1, 0] * W[1, 1], feature(1))),
        Gate("SWAP", (0, 1)),
        Gate("MultiRZ", (0, 1, 2), (W[1, 2],)),
        Gate("RY", (1,), (W[1, 0],)),
        Gate("SX", (1,)),
    ),
    observables=(
        ((0, "X"), (1, "Y")),
        ((0, "Z"),),
        Hamiltonian((0.7, -1.0, 0.25), (((0, "Z"), (2, "Z")), ((1, "X"),), ())),
        Probabilities((2, 0)),
    ),
)


def results(layer, batch, dtype=torch.float64):
    """Outputs, and gradients of the input and of every weight."""
    generator = torch.Generator().manual_seed(5)
    x = torch.randn(batch, FEATURES, generator=generator, dtype=torch.float64).to(dtype).requires_grad_()
    y = layer(x)
    g = torch.randn(y.shape, generator=generator, dtype=torch.float64).to(dtype)
    return [y.detach(), *torch.autograd.grad(y, [x, *layer.parameters()], g)]


def layers(circuit):
    torch.manual_seed(0)
    fast, plain = QuantumLayer(circuit).double(), QuantumLayer(circuit, backend="torch").double()
    plain.load_state_dict(fast.state_dict())
    return fast, plain


def kinds(circuit):
    return [type(block) for block in program(circuit).blocks]


def test_program_is_the_same_whichever_way_gates_are_ordered():
    """Wire by wire or layer by layer, as gates with Rot taken apart: what commutes merges."""
    layered = ANSATZE.build("qiren", 4, 2)
    by_wire = sorted(layered.operations[:4], key=lambda gate: -gate.wires[0])
    apart = [
        Gate(name, gate.wires, (angle,)) if gate.name == "Rot" else gate
        for gate in (*by_wire, *layered.operations[4:])
        for name, angle in (zip(("RZ", "RY", "RZ"), gate.angles, strict=True) if gate.name == "Rot" else [("", 0.0)])
    ]
    other = replace(layered, operations=tuple(apart))
    assert kinds(other) == kinds(layered)
    assert kinds(layered)[:4] == [RYLayer, Diagonal, RYLayer, Diagonal]
    assert program(other).operations == program(layered).operations


def test_program_leaves_out_what_has_no_effect():
    zz = (Gate("CNOT", (0, 1)), Gate("RZ", (1,), (W[0, 0],)), Gate("CNOT", (0, 1)))
    turned = (Gate("RX", (0,), (feature(0),)), Gate("RX", (1,), (feature(1),)))
    for operations, cnots, weights in (
        ((*turned, *zz), 0, 0),  # phases before Z is measured
        ((*zz, *turned), 0, 0),  # phases of |0...0>
        ((*turned, Gate("CNOT", (0, 1))), 0, 0),  # at the end: Z becomes ZZ
        ((*turned, Gate("X", (0,)), Gate("Y", (1,))), 0, 0),  # Pauli gates turn signs
        ((*turned, *zz, Gate("CNOT", (1, 2)), *turned), 1, 1),
    ):
        circuit = Circuit("few", 3, operations=operations, observables=(((0, "Z"),), ((1, "Z"),)), weights=(W,))
        found = program(circuit)
        assert sum(isinstance(block, CNOTs) for block in found.blocks) <= cnots
        angles = [angle for block in found.blocks for _, angle in rotations_of(block, 3)]
        assert len({own for angle in angles for own in angle.weights}) == weights
        fast, plain = QuantumLayer(circuit), QuantumLayer(circuit, method="pennylane")
        plain.load_state_dict(fast.state_dict())
        x = torch.randn(4, 3)
        torch.testing.assert_close(fast(x), plain(x), rtol=0, atol=2e-6)


@pytest.mark.parametrize(
    ("name", "value"), [("CHUNK_BYTES", 20_000), ("takes_dense_blocks", lambda device, wires: True)]
)
def test_plain_torch_is_the_same_in_chunks_and_by_dense_blocks(name, value, monkeypatch):
    """With a start for each sample, and without; dense blocks are what a GPU takes."""
    named = (ANSATZE.build("qiren", 4, 2), ANSATZE.build("cnot", 3, 2), ANSATZE.build("rx", 3, 1))
    for circuit in (MIXED, replace(MIXED, operations=MIXED.operations[1:]), *named):
        _, plain = layers(replace(circuit, features=FEATURES))
        whole = results(plain, 23)
        with monkeypatch.context() as patch:
            patch.setattr(statevector, name, value)
            for one, two in zip(results(plain, 23), whole, strict=True):
                torch.testing.assert_close(one, two, rtol=1e-13, atol=1e-13)


def test_float32_threads_and_blocks():
    fast, plain = layers(MIXED)
    exact = results(plain, 700)
    single, found = fast.float(), []
    for count in (1, 2):
        torch.set_num_threads(count)
        found.append(results(single, 700, torch.float32))
    assert all(map(torch.equal, *found))
    for one, expected in zip(found[0], exact, strict=True):
        torch.testing.assert_close(one.double(), expected, rtol=1e-4, atol=1e-5)


def test_samples_do_not_depend_on_their_neighbours():
    x = torch.randn(40, FEATURES, generator=torch.Generator().manual_seed(0))
    x[3], x[20] = float("nan"), float("inf")
    layer = QuantumLayer(MIXED)
    assert layer(x).isnan().any(1).nonzero().flatten().tolist() == [3, 20]
    assert torch.equal(layer(x[4:20]), layer(x)[4:20])


def test_batches_of_any_shape_and_number_of_weights():
    layer = QuantumLayer(MIXED)
    assert layer.scale.item() == 1.0
    for other in layers(MIXED):
        assert other(torch.randn(2, 0, FEATURES)).shape == (2, 0, 7)
    assert layer(torch.randn(FEATURES)).shape == (7,)
    fixed = QuantumLayer(
        Circuit("fixed", 1, operations=(Gate("RX", (0,), (0.3,)),), observables=(((0, "Z"),),), features=0)
    )
    assert torch.allclose(fixed(torch.zeros(4, 0)), torch.tensor(0.3).cos().expand(4, 1))
    with pytest.raises(ValueError, match="mixed has a start that depends on the input; choose method=auto"):
        QuantumLayer(MIXED, method="lightcone")


def of(*operations: Any, measured: Any = ((0, "Z"),)) -> Circuit:
    return Circuit("wrong", 2, operations=operations, observables=(measured,), weights=(W,))


MISTAKES = [
    (lambda: Gate("RW", (0,)), "unknown gate 'RW'; known: X, Y, Z, H"),
    (lambda: Gate("CNOT", (0,)), r"CNOT expects 2 wires, got \(0,\)"),
    (lambda: Gate("CNOT", (1, 1)), "CNOT expects different wires"),
    (lambda: Gate("RX", (0,)), "RX expects 1 angles, got 0"),
    (lambda: Gate("RX", (0,), (float("nan"),)), "finite numbers, got nan"),
    (lambda: Gate("PauliRot", (0,), (1.0,), "XY"), "a letter for each of the wires"),
    (lambda: Amplitudes((0, 1), (1.0,)), "2 wires expect 4 values, got 1"),
    (lambda: feature(0) / feature(1), "cannot divide"),
    (lambda: Weights("a b", (2,)), "an identifier, got 'a b'"),
    (lambda: Hamiltonian((1.0,), ()), "one finite coefficient for each word"),
    (lambda: Gate("X", "a"), "X expects wires as integers from 0, got 'a'"),
    (lambda: of(measured="ZZ"), "observable 'ZZ' expects pairs of a wire and a letter"),
    (lambda: of(measured=(0, "Z")), r"observable \(0, 'Z'\) expects pairs of a wire and a letter"),
    (lambda: of(measured=qml.Z(0)), r"or a Hamiltonian, or Probabilities"),
    (lambda: QuantumLayer(of())(np.zeros((1, 2))), r"tensor \(..., 2\) of angles in radians, got ndarray"),
    (lambda: of(Gate("X", (2,))), "needs wires below 2"),
    (lambda: of(Gate("RX", (0,), (feature(2),))), "the input has 2 features"),
    (lambda: of(Gate("RX", (0,), (weight("v", 0),))), r"declared weights: w with 6"),
    (lambda: of(Gate("X", (0,)), Amplitudes((0,), (1.0, 0.0))), "must come before every gate"),
    (lambda: of(measured=Probabilities((0, 0))), "probabilities of wires .* need different wires below 2"),
    (lambda: of(measured=Hamiltonian((1.0,), (((0, "A"),),))), "letters X, Y, Z"),
    (lambda: QuantumLayer(Circuit("c", 1, observables=((),), weights=(Weights("forward", (1,)),))), "an attribute"),
    (lambda: of(*entanglers("CY", ((0, 2),))), "needs wires below 2"),
    (lambda: encoding("W", (1.0, 1.0)), "unknown gate 'RW'"),
    (lambda: of("RX"), "unknown operation 'RX'; known: Gate, Amplitudes"),
    (lambda: Circuit("wrong", 2), "needs at least one observable"),
    (lambda: of(measured=((0, "Z"), (0, "Z"))), "has more than one letter on a wire"),
]


def test_mistakes_in_descriptions_are_one_line():
    for make, message in MISTAKES:
        with pytest.raises(ValueError, match=message) as error:
            make()
        assert "\n" not in str(error.value)


def test_descriptions_take_lists_single_wires_rows_of_weights_and_long_names():
    v = Weights("v", 3)
    loose = Circuit(
        "loose", 2, features=2, weights=W,  # one for all
        operations=[
            [Gate("Hadamard", 0), [Gate("Rot", [1], W[1])]], Gate("RX", 0, feature(1)), Gate("PauliX", np.int64(1)),
            Gate("CRot", range(2), [0.5, W[0, 1], np.pi * feature(0)]),
        ],
        observables=[[[0, "Z"]], Hamiltonian([1, 2.0], [[(0, "X")], [(1, "Y")]]), Probabilities([1])],
    )  # fmt: skip
    strict = Circuit(
        "loose", 2, features=2, weights=(W,),
        operations=(
            Gate("H", (0,)), Gate("Rot", (1,), (W[1, 0], W[1, 1], W[1, 2])), Gate("RX", (0,), (feature(1),)),
            Gate("X", (1,)), Gate("CRot", (0, 1), (0.5, W[0, 1], np.pi * feature(0))),
        ),
        observables=(((0, "Z"),), Hamiltonian((1.0, 2.0), (((0, "X"),), ((1, "Y"),))), Probabilities((1,))),
    )  # fmt: skip
    assert loose == strict
    assert (v.shape, len(v), len(W), list(v)) == ((3,), 3, 2, [v[0], v[1], v[2]])
    assert Circuit("one", 1, observables=Probabilities(0)).outputs == 2
    for index in (2, (0, 3), (0, 0, 0), (0, slice(None))):
        with pytest.raises(IndexError, match=r"weights w have shape \(2, 3\), got the index"):
            W[index]


def test_expressions_are_polynomials_with_one_form():
    x, y = feature(0), weight("w", 0)
    assert (x + 1) ** 2 - 1 == x * x + 2 * x
    assert 1 - x / 2 == 1 + -0.5 * x
    assert (x - x).constant == 0
    assert not x - x
    assert +x == x
    assert y != x
    for wrong in (lambda: x == 1.0, lambda: bool(y), lambda: x**-1, lambda: x**0.5, lambda: x * float("inf")):
        with pytest.raises(ValueError, match=r"form of a circuit|cannot take the power|finite numbers"):
            wrong()
    with pytest.raises(TypeError):
        x + "a"


def test_circuit_without_features_needs_no_input():
    layer = QuantumLayer(Circuit("vqe", 1, (Gate("RX", 0, W[0, 0]),), (((0, "Z"),),), 0, W))
    assert torch.allclose(layer(), layer.w[0, 0].cos()[None])
    with pytest.raises(
        ValueError, match=r"expects a floating-point tensor \(..., 4\) of angles in radians, got NoneType"
    ):
        QuantumLayer(MIXED)()


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of torch.jit
def test_trace_that_would_hold_constants_is_refused():
    with pytest.raises(ValueError, match=r"torch\.compile takes a QuantumLayer"):
        torch.jit.trace(QuantumLayer(MIXED), torch.rand(3, FEATURES))
    with pytest.raises(ValueError, match=r"torch\.export and torch\.jit\.trace see no circuit"):
        torch.export.export(QuantumLayer(MIXED), (torch.rand(3, FEATURES),))
