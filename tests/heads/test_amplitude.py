"""Amplitude heads: fast forms against gates one by one, and what the equations promise."""

import math

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qnerf.heads import HEADS
from qnerf.heads.amplitude import System
from qnerf.heads.registers import BlochRegister
from qnerf.quantum.basis import bit

VARIANTS = [
    {},
    {"rotations": "Rot", "hidden": 4},
    {"encoding": "softmax", "readout": False},
    {"encoding": "softmax", "unitary": "local", "values": "Z"},
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


def rotated(state: torch.Tensor, angles: torch.Tensor, wire: int, wires: int) -> torch.Tensor:
    """RZ(omega) RY(theta) RZ(phi) on a wire of states (N, 2^n); of one angle, RY."""
    phi, theta, omega = angles if len(angles) == 3 else (0 * angles[0], angles[0], 0 * angles[0])
    view = state.reshape(-1, 2**wire, 2, 2 ** (wires - wire - 1))
    zero, one = (view[:, :, bit] * torch.exp(sign * 0.5j * phi) for bit, sign in ((0, -1), (1, 1)))
    c, s = (theta / 2).cos(), (theta / 2).sin()
    parts = (c * zero - s * one) * torch.exp(-0.5j * omega), (s * zero + c * one) * torch.exp(0.5j * omega)
    return torch.stack(parts, 2).reshape(state.shape)


def gate_by_gate(system, parts, features, weights):
    """What a system computes: its state prepared, the circuit run gate by gate, and measured."""
    state, n, unitaries = system.prepared(parts, features), system.wires, system.unitaries
    state, index = state.to(state.dtype.to_complex()), 0
    matrices = unitaries()
    bits = torch.stack([(torch.arange(2**n) & bit(wire, n) != 0).long() for wire in range(n)], 1)
    first_of_encoding = (gate for gate in unitaries.circuit.gates if gate.name != "RZ" or gate.wires == (0,))
    for gate in (*first_of_encoding, None):
        if gate is None or gate.name == "RZ":  # the end of a block
            if unitaries.kind not in ("circuit", "local") and matrices[index] is not None:
                state = state @ matrices[index].to(state.dtype).T
            if gate is not None:
                angles = system.upload(features) * system.frequencies[index]
                state = state * torch.exp(-0.5j * (angles @ (1 - 2 * bits).T.double()))
            index += 1
        elif unitaries.kind in ("circuit", "local") and gate.name == "Rot":
            ((_, place),) = gate.angles[0].weights
            state = rotated(state, unitaries.angles[place // (3 * n), gate.wires[0]], gate.wires[0], n)
        elif unitaries.kind in ("circuit", "local"):
            control, target = gate.wires
            state = state * (1.0 - 2.0 * bits[:, control] * bits[:, target])
    return state.abs().square() @ system.measured.T @ weights.T


def test_heads_compute_what_their_circuits_give_gate_by_gate(monkeypatch):
    for options in VARIANTS:
        head, x = built(options)
        weights = torch.randn(4, 2, dtype=torch.float64)
        sources, results = [x, *head.parameters()], []
        for forward in (System.forward, gate_by_gate):
            monkeypatch.setattr(System, "forward", forward)
            out = head(x)
            results.append([out, *torch.autograd.grad((out * weights).sum(), sources, allow_unused=True)])
        monkeypatch.undo()
        for ours, theirs in zip(*results, strict=True):
            torch.testing.assert_close(ours, theirs, msg=lambda text, options=options: f"{options}: {text}")
        if options.get("readout", True):
            torch.testing.assert_close(head(torch.zeros_like(x)), torch.zeros(4, 2, dtype=torch.float64))
        assert torch.autograd.gradcheck(head, x, fast_mode=True)


@settings(max_examples=30)
@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda d: math.hypot(*d) > 0.01))
def test_bloch_register_points_in_the_direction(direction):
    d = torch.tensor([direction], dtype=torch.float64, requires_grad=True)
    ((a, b),) = BlochRegister(3, 1)(d)
    bloch = torch.stack([2 * (a.conj() * b).real, 2 * (a.conj() * b).imag, a.abs() ** 2 - b.abs() ** 2])
    torch.testing.assert_close(bloch, (d / d.norm())[0])
    (gradient,) = torch.autograd.grad(bloch.sum(), d)
    assert bool(gradient.isfinite().all())


def test_labels_name_what_is_not_the_default():
    defaults = {key: parameter.default for key, parameter in HEADS.options("amplitude").items()}
    for options, label in (
        ({}, "amplitude6"),
        ({"registers": [3, 3], "branch": "bloch"}, "amplitude3+3-bloch"),
        ({"unitary": "identity", "uploads": 1, "readout": False}, "amplitude6-identity-uploads=1-readout=false"),
    ):
        assert HEADS.get("amplitude").label(defaults | options) == label


def test_options_that_are_not_read_change_nothing():
    others = {
        "hidden": 4, "bias": 0.7, "branch": "bloch", "layers": 3, "rotations": "Rot", "frequencies": "ternary",
    }  # fmt: skip
    defaults = {name: parameter.default for name, parameter in HEADS.options("amplitude").items()}
    for options in VARIANTS:
        expected = (head := built(options))[0](head[1])
        for name in HEADS.get("amplitude").without_effect(defaults | options):
            head, x = built(options | {name: others[name]})
            assert torch.equal(head(x), expected), (options, name)
