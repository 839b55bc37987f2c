"""Amplitude heads: fast forms against gates one by one, and what the equations promise."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qnerf.heads import HEADS
from qnerf.heads.amplitude import NormalisedForms, normalised_forms
from qnerf.heads.registers import BlochRegister
from qnerf.quantum.unitary import blocks, layered

VARIANTS = [
    {},
    {"entangler": "CNOT", "rotations": "Rot"},
    {"amplitudes": "complex", "values": "probabilities"},
    {"amplitudes": "complex", "rotations": "Rot", "hidden": 4},
    {"encoding": "softmax", "readout": False},
    {"encoding": "softmax", "amplitudes": "complex", "unitary": "local", "values": "Z"},
    {"unitary": "identity"},
    {"unitary": "dense"},
    {"unitary": "random", "rotations": "Rot"},
    {"unitary": "dense", "rotations": "Rot", "uploads": 1},
    {"registers": [1, 1, 1]},
    {"registers": [2, 1], "branch": "amplitude", "uploads": 2, "frequencies": "ternary"},
    {"registers": [1, 2], "branch": "bloch", "rotations": "Rot"},
    {"registers": [2, 2], "joint": False, "uploads": 1},
    {"registers": [2, 2], "joint": False},
    {"encoding": "none", "uploads": 2, "frequencies": "ternary", "rotations": "Rot"},
]


def built(options: dict) -> tuple[torch.nn.Module, torch.Tensor]:
    torch.manual_seed(0)
    torch.set_default_dtype(torch.float64)
    try:
        head = HEADS.build("amplitude", 5, 2, **{"registers": [3], "layers": 2} | options)
        return head, torch.randn(4, 5, requires_grad=True)
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("options", VARIANTS, ids=str)
def test_a_head_computes_what_its_circuit_gives_gate_by_gate(options):
    head, x = built(options)
    weights = torch.randn(4, 2, dtype=torch.float64)
    sources = [x, *(p for p in head.parameters())]
    results = []
    for evaluate in (head, head.plain):
        out = evaluate(x)
        results.append([out, *torch.autograd.grad((out * weights).sum(), sources, allow_unused=True)])
    for ours, theirs in zip(*results, strict=True):
        torch.testing.assert_close(ours, theirs)
    if options.get("readout", True):
        torch.testing.assert_close(head(torch.zeros_like(x)), torch.zeros(4, 2, dtype=torch.float64))
    assert torch.autograd.gradcheck(head, x, fast_mode=True)


def test_the_own_backward_pass_is_right_to_the_second_derivative():
    u, weights = (torch.randn(n, 4, dtype=torch.float64, requires_grad=True) for n in (3, 2))
    torch.testing.assert_close(NormalisedForms.apply(u, weights), normalised_forms(u, weights)[-1])
    assert torch.autograd.gradcheck(NormalisedForms.apply, (u, weights))
    assert torch.autograd.gradgradcheck(NormalisedForms.apply, (u, weights))
    assert torch.autograd.gradgradcheck(lambda u: NormalisedForms.apply(u, weights.detach()), u)


def test_the_linear_map_that_makes_the_amplitudes_can_take_the_place_of_any_unitary():
    head, x = built({"unitary": "dense"})
    (unitary,) = head.systems[0].unitaries()
    free, _ = built({"unitary": "identity"})
    free.load_state_dict(head.state_dict(), strict=False)
    linear = free.systems[0].registers[0].linear
    with torch.no_grad():
        linear.weight.copy_(unitary @ linear.weight)
        linear.bias.copy_(unitary @ linear.bias)
    torch.testing.assert_close(free(x), head(x))


def test_a_circuit_acts_on_a_product_state_as_no_linear_map_of_one_register_can():
    """Without a circuit <Z_i Z_j> = <Z_i> <Z_j>; with one the state is entangled."""
    for unitary, entangled in (("identity", False), ("local", False), ("circuit", True)):
        head, x = built({"registers": [1, 1, 1], "unitary": unitary, "readout": False, "gain": 1.0})
        head.out_dim = 6
        z, pairs = head(x).split(3, 1)
        products = torch.stack([z[:, 0] * z[:, 1], z[:, 0] * z[:, 2], z[:, 1] * z[:, 2]], 1)
        assert torch.allclose(pairs, products) is not entangled


@settings(max_examples=30)
@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda d: math.hypot(*d) > 0.01))
def test_a_qubit_points_in_the_direction(direction):
    d = torch.tensor([direction], dtype=torch.float64, requires_grad=True)
    ((a, b),) = BlochRegister(3, 1)(d)
    bloch = torch.stack([2 * (a.conj() * b).real, 2 * (a.conj() * b).imag, a.abs() ** 2 - b.abs() ** 2])
    torch.testing.assert_close(bloch, (d / d.norm())[0])
    (gradient,) = torch.autograd.grad(bloch.sum(), d)
    assert bool(gradient.isfinite().all())


def test_groups_of_wires_are_circuits_of_their_own():
    angles = torch.randn(2, 3, 1, dtype=torch.float64)
    (whole,) = blocks(layered(3, 2, groups=(2, 1)), angles)
    (first,), (second,) = blocks(layered(2, 2), angles[:, :2]), blocks(layered(1, 2), angles[:, 2:])
    torch.testing.assert_close(whole, torch.kron(first, second))


@pytest.mark.parametrize(
    ("options", "label"),
    [
        ({}, "amplitude6"),
        ({"registers": [3, 3], "branch": "bloch"}, "amplitude3+3-bloch"),
        ({"unitary": "identity", "uploads": 1, "readout": False}, "amplitude6-identity-uploads=1-readout=false"),
    ],
)
def test_a_label_names_what_is_not_the_default(options, label):
    defaults = {key: parameter.default for key, parameter in HEADS.options("amplitude").items()}
    assert HEADS.get("amplitude").label(defaults | options) == label


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"registers": [6, 6]}, "at most 10 qubits together"),
        ({"registers": [0]}, r"registers\[0\]"),
        ({"registers": []}, "registers"),
        ({"branch": "amplitude"}, "expects two registers"),
        ({"encoding": "none"}, "uploads of at least 1"),
        ({"registers": [2, 1], "branch": "bloch", "direction_features": 2}, "3 coordinates"),
        ({"readout": False, "values": "Z", "registers": [1]}, "expects at least 2 values, got 1"),
    ],
)
def test_a_mistake_is_one_line(options, message):
    with pytest.raises(ValueError, match=message) as caught:
        HEADS.build("amplitude", 5, 2, **options)
    assert "\n" not in str(caught.value)


def test_parameters_are_those_of_the_docs():
    for wires, count in ((6, 988), (4, 290)):
        head = HEADS.build("amplitude", 12, 6, registers=[wires])
        assert sum(p.numel() for p in head.parameters()) == count
