"""Controls of circuit heads, QIREN beside a linear map, and angles that a network makes."""

import itertools
import math

import pennylane as qml
import pytest
import torch
from torch import nn

from qnerf.heads import HEADS, QirenHead
from tests.helpers.configs import composed


def test_siren_starts_as_published():
    head = HEADS.build("siren", 5, 2, layers=3, width=64, omega=10.0)
    bounds = [1 / 5, math.sqrt(6 / 64) / 10, math.sqrt(6 / 64) / 10]
    for layer, bound in zip(head.layers, bounds, strict=True):
        assert 0.7 * bound < float(layer.weight.detach().abs().max()) <= bound
    x = torch.randn(7, 5)
    hidden = torch.sin(10 * head.layers[1](torch.sin(10 * head.layers[0](x))))
    torch.testing.assert_close(head(x), head.layers[2](hidden))


def test_surrogate_has_the_frequencies_of_its_circuit_and_no_others():
    head = HEADS.build("surrogate", 2, 1, qubits=2, spectral=3, features=200, input_scale=1.0).double().eval()
    with torch.no_grad():
        head.linear.weight.copy_(torch.eye(2))
        head.linear.bias.zero_()
    size = 16
    angles = torch.arange(size, dtype=torch.float64) * (2 * math.pi / size) * math.sqrt(1 + head.norm.eps)
    values = head(torch.stack([angles, torch.zeros(size, dtype=torch.float64)], 1))[:, 0].detach()
    powers = torch.fft.rfft(values).abs()
    assert float(powers[1:4].min()) > 1e-3
    assert float(powers[4:].max()) < 1e-9
    assert float(head(torch.zeros(1, 2, dtype=torch.float64)).detach().abs()) < 1e-5


def test_surrogate_bias_before_its_normalisation_stays_where_it_is():
    head = HEADS.build("surrogate", 3, 2, qubits=2)
    head(torch.randn(16, 3)).square().sum().backward()
    assert float(head.linear.bias.grad.abs().max()) == 0
    assert float(head.linear.weight.grad.abs().max()) > 0


def test_qrun_is_what_its_published_code_computes():
    head = HEADS.build("qrun", 3, 2, layers=3, width=4, input_scale=2.0).double()
    x = torch.randn(5, 3, dtype=torch.float64)
    values = 2 * head.first(x)
    for layer in head.hidden:
        inputs, found = layer.linear(values), torch.empty(5, 4, dtype=torch.float64)
        for sample, unit in itertools.product(range(5), range(2)):
            h = inputs[sample, unit]
            one, two, three = layer.net[::2]
            hidden = torch.tanh(one.weight @ torch.stack([h.sin(), h.cos(), h.sin(), h.cos()]) + one.bias)
            hidden = torch.tanh(two.weight @ hidden + two.bias)
            found[sample, 2 * unit : 2 * unit + 2] = torch.sin(three.weight @ hidden + three.bias)
        values = found
    torch.testing.assert_close(head(x), head.readout(values))
    with pytest.raises(ValueError, match="even"):
        HEADS.build("qrun", 3, 2, width=5)


def test_residual_stages_learn_one_after_another_what_the_sum_leaves():
    head = HEADS.build("residual", 2, 1, stages=3, qubits=2, spectral=1).double()
    stages, x = [nn.ModuleList([head.hybrid, head.readout]), *head.later], torch.randn(8, 2, dtype=torch.float64)
    for number, progress in enumerate((0.0, 0.5, 0.7)):
        head.zero_grad()
        head.progress = progress
        head.train()(x).square().sum().backward()
        assert [any(p.grad is not None for p in stage.parameters()) for stage in stages] == [
            k == number for k in range(3)
        ]
    head.progress, values, total = 1.0, QirenHead.forward(head.eval(), x), 0
    for stage in (*head.later, None):
        total = total + values
        values = stage and stage(torch.cat([x, values], 1))
    torch.testing.assert_close(head(x), total)


@pytest.mark.parametrize("trained", [False, True])
def test_qkan_has_a_circuit_of_one_qubit_on_each_edge(trained):
    head = HEADS.build("qkan", 3, 2, layers=1, repeats=2, input_scale=1.5, trained_inputs=trained).double()
    layer, x = head.layers[0], torch.randn(4, 3, dtype=torch.float64)
    if trained:
        layer.shifts.data.normal_()

    @qml.qnode(qml.device("default.qubit", wires=1))
    def edge(theta, scales, shifts, value):
        qml.Hadamard(0)
        for turn in range(len(theta)):
            qml.RZ(theta[turn, 0], 0)
            qml.RY(theta[turn, 1], 0)
            if turn < len(scales):
                qml.RZ(scales[turn] * value + shifts[turn], 0)
        return qml.expval(qml.Z(0))

    expected = torch.zeros(4, 2, dtype=torch.float64)
    for sample, out, into in itertools.product(range(4), range(2), range(3)):
        scales = layer.scales[out, into] if trained else torch.full((2,), 1.5)
        shifts = layer.shifts[out, into] if trained else torch.zeros(2)
        value = edge(layer.theta[out, into], scales, shifts, x[sample, into])
        silu = x[sample, into] * torch.sigmoid(x[sample, into])
        expected[sample, out] += value + layer.base[out, into] * silu
    torch.testing.assert_close(head(x), expected)


def test_tensor_train_is_multilinear_in_cosines_and_sines_of_its_angles():
    """So it is a sum over all 2^n choices of a cosine or a sine, each with a product of matrices as coefficient."""
    head = HEADS.build("tensor_train", 2, 2, sites=3, rank=2, input_scale=0.7).double()
    x = torch.randn(4, 2, dtype=torch.float64)
    angles = 0.7 * head.linear(x)
    state = torch.zeros(4, 2, dtype=torch.float64)
    for choice in itertools.product((0, 1), repeat=3):
        factor, row = torch.ones(4, dtype=torch.float64), head.first
        for site, sine in enumerate(choice):
            factor = factor * (angles[:, site].sin() if sine else angles[:, site].cos())
            row = row @ (head.sines if sine else head.cosines)[site]
        state = state + factor[:, None] * row
    torch.testing.assert_close(head(x), head.readout(state))


def test_qiren_controls_take_out_entanglers_and_training():
    local = HEADS.build("qiren", 3, 2, qubits=3, unitary="local").double().hybrid[0].circuit
    x = torch.randn(1, 3, dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(local, x)[0, :, 0]
    torch.testing.assert_close(jacobian, torch.diag(torch.diag(jacobian)), atol=1e-12, rtol=0)
    head = HEADS.build("qiren", 3, 2, qubits=3, unitary="random")
    head(torch.randn(8, 3)).square().sum().backward()
    assert {name for name, p in head.named_parameters() if p.grad is None} == {
        f"hybrid.{index}.circuit.weights{number}" for index in (0, 1) for number in (1, 2)
    }


def test_bypass_is_all_there_is_at_the_start():
    head = HEADS.build("qiren_bypass", 5, 2, qubits=3, spectral=1, center=True)
    x = torch.randn(9, 5)
    torch.testing.assert_close(head(x), head.bypass(x))
    head(x).sum().backward()
    assert float(head.readout.weight.grad.abs().max()) > 0


def test_wire_per_feature_and_pairs_of_observables():
    head = HEADS.build("qiren_bypass", 4, 2, spectral=1, wire_per_feature=True, pairs=True, from_zero=False).double()
    layer = head.hybrid[0].circuit
    assert (layer.wires, layer.outputs) == (4, 10)
    single = HEADS.build("qiren", 4, 2, spectral=1, qubits=4).double().hybrid[0].circuit
    single.load_state_dict(layer.state_dict())
    x = torch.randn(3, 4, dtype=torch.float64)
    torch.testing.assert_close(layer(x)[:, :4], single(x))
    plain = HEADS.build("qiren_bypass", 4, 2, spectral=1, qubits=3, bypass=False, from_zero=False)
    assert plain.bypass is None


def test_hyper_runs_its_own_circuit_for_each_sample():
    for unitary in ("circuit", "local"):
        torch.manual_seed(0)
        head = HEADS.build("hyper", 8, 2, layers=2, unitary=unitary, gain=2.0).double()
        x = torch.randn(2, 8, dtype=torch.float64)
        x[0, :3] = torch.tensor([0.0, 0.0, -1.0])  # a pole, where the longitude is any
        longitude = torch.atan2(x[:, 1], x[:, 0])
        latitude = torch.acos(torch.nn.functional.normalize(x[:, :3], dim=1)[:, 2])
        angles = head.network(x[:, 3:]).view(2, 2, 3, 2)  # layer, wire, RZ and RY

        @qml.qnode(qml.device("default.qubit", wires=3), interface="torch")
        def values(start, turn, layers, entangled):
            for wire in range(3):
                qml.RY(start, wire)
                qml.RZ(turn, wire)
            for layer in layers:
                for wire, (z, y) in enumerate(layer):
                    qml.RZ(z, wire)
                    qml.RY(y, wire)
                for pair in ((0, 1), (1, 2), (2, 0)) if entangled else ():
                    qml.CNOT(pair)
            return [qml.expval(qml.Z(wire)) for wire in range(3)]

        samples = zip(latitude, longitude, angles, strict=True)
        expected = torch.stack([torch.stack(values(*one, unitary == "circuit")) for one in samples])
        torch.testing.assert_close(head(x), head.readout(2 * expected))
    moved = x.clone().requires_grad_()
    head(moved).sum().backward()
    assert torch.isfinite(moved.grad).all()


def test_recipes_give_a_head_what_its_class_names():
    """Without an entry of its own in conf/."""
    for head, rate, initial in (("amplitude", 1.0, 1.0), ("surrogate", 0.33, 0.1), ("qiren_bypass", 0.33, 0.1)):
        quick, paper = composed(f"density={head}"), composed(f"density={head}", "train=paper")
        assert (quick["train"]["rates"]["density"], quick["density"]["initial"]) == (rate, initial)
        assert (paper["train"]["rates"]["density"], paper["density"]["initial"]) == (1.0, 1.0)
        assert head not in quick["density"]["rates"]
        assert composed(f"color={head}", "train=paper")["color"]["activation"] == ("linear" if rate < 1 else "sigmoid")
