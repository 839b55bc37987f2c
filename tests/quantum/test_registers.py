"""Wide circuits as registers, against the state of all wires where that fits, else against closed forms."""

from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from torch import Tensor

from qnerf.quantum import statevector
from qnerf.quantum.circuit import ANSATZE, Circuit
from qnerf.quantum.layer import QuantumLayer
from qnerf.quantum.normal_form import normal_form
from qnerf.quantum.registers import is_split, registers
from qnerf.quantum.simulator import Simulator
from tests.quantum import test_engines


def results(function: Any, x: Tensor, weights: Tensor) -> list[Tensor]:
    """Outputs, and gradients of inputs and weights."""
    x, weights = x.clone().requires_grad_(), weights.clone().requires_grad_()
    y = function(x, weights)
    factors = torch.linspace(-1, 1, y.numel(), dtype=y.dtype).view_as(y)
    return [y.detach(), *torch.autograd.grad((y * factors).sum(), (x, weights))]


def assert_same(found: list[Tensor], expected: list[Tensor]) -> None:
    for one, two, tolerance in zip(found, expected, (1e-12, 1e-11, 1e-11), strict=True):
        torch.testing.assert_close(one, two, rtol=tolerance, atol=tolerance)


def inputs(circuit: Circuit, batch: int = 3) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(batch, circuit.features or 0, generator=generator, dtype=torch.float64)
    weights = 3 * torch.randn(circuit.size, generator=generator, dtype=torch.float64)
    return x, weights


@settings(max_examples=20)
@given(circuit=test_engines.circuits())
def test_registers_of_a_reuploading_circuit_give_what_the_whole_gives(circuit: Circuit) -> None:
    simulator = Simulator(circuit, "statevector")
    assert_same(results(simulator.of_registers, *inputs(circuit)), results(simulator, *inputs(circuit)))


def test_polynomials_of_a_wide_circuit_are_those_of_its_registers() -> None:
    for name in ("qiren", "rx"):
        circuit = ANSATZE.build(name, 14, 1)
        circuit = replace(circuit, observables=(*circuit.observables, ()))  # the identity, which has no cone
        assert is_split(circuit)
        x, weights = inputs(circuit, batch=2)
        expected = results(partial(statevector.evaluate, normal_form(circuit)), x, weights)
        for simulator in (Simulator(circuit, "lightcone"), Simulator(circuit, "statevector")):
            assert_same(results(simulator, x, weights), expected)
        plain = Simulator(circuit, "lightcone", "torch")
        assert_same(results(plain, x, weights), expected)


def test_output_of_64_wires_sees_what_a_smaller_ring_sees() -> None:
    """Output 30 of 64 wires depends on wires 26..34 alone. A ring of 12 wires looks the same to it."""
    wide, small = ANSATZE.build("qiren", 64, 1), ANSATZE.build("qiren", 12, 1)
    assert {part.circuit.wires for part in registers(wide)} == {9}
    layer = QuantumLayer(wide)
    x, weights = inputs(wide, batch=200)
    near = slice(24, 36)
    ring_of_12 = Simulator(small, "statevector")
    expected = results(lambda x, w: ring_of_12(x[:, near], w.reshape(4, 64, 3)[:, near].flatten())[:, 6], x, weights)
    simulator = Simulator(wide, "lightcone")
    assert_same(results(lambda x, w: simulator(x, w)[:, 30], x, weights), expected)
    assert layer.cost(6144).method == "lightcone"
    assert layer.cost(6144).memory < 2**28


def test_wires_that_do_not_fit_say_so() -> None:
    wide = ANSATZE.build("qiren", 64, 1)
    layer = QuantumLayer(wide, shots=10)
    assert layer(torch.zeros(2, 64)).shape == (2, 64)
    with pytest.raises(ValueError, match="circuit cnot: one state of 64 wires takes"):
        QuantumLayer(ANSATZE.build("cnot", 64, 1))
    with pytest.raises(ValueError, match="the whole state of circuit qiren: one state of 64 wires"):
        statevector.probabilities(normal_form(wide), torch.zeros(1, 64), torch.zeros(4 * 3 * 64))
