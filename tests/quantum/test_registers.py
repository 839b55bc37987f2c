"""Wide circuits as registers, against the state of all wires where that fits, else against closed forms."""

from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from hypothesis import assume, given, settings
from torch import Tensor

from qnerf.quantum import statevector
from qnerf.quantum.circuit import (
    ANSATZE,
    Amplitudes,
    Circuit,
    Gate,
    Hamiltonian,
    Probabilities,
    Weights,
    feature,
    ring,
)
from qnerf.quantum.layer import QuantumLayer
from qnerf.quantum.normal_form import normal_form
from qnerf.quantum.registers import is_split, registers
from qnerf.quantum.simulator import Simulator
from tests.quantum import test_any_circuit, test_engines


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


@settings(max_examples=20)
@given(circuit=test_any_circuit.circuits())
def test_registers_of_any_circuit_give_what_the_whole_gives(circuit: Circuit) -> None:
    assume(registers(circuit))  # not all outputs are constants
    simulator = Simulator(circuit)
    assert_same(results(simulator.of_registers, *inputs(circuit)), results(simulator, *inputs(circuit)))


def test_polynomials_of_a_wide_circuit_are_those_of_its_registers() -> None:
    for name in ("qiren", "rx"):
        circuit = ANSATZE.build(name, 14, 1)
        circuit = replace(circuit, observables=(*circuit.observables, ()))  # the identity, which is no register's
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


def test_wide_circuit_of_gates_equals_its_closed_form() -> None:
    """RX on every wire, a ring of CZ, RX: <Z_i> = cos a cos x_i + sin a sin x_i cos x_i-1 cos x_i+1."""
    n = 64
    w = Weights("w", (3,))
    operations = (
        *(Gate("RX", (wire,), (feature(wire),)) for wire in range(n)),
        *(Gate("CZ", pair) for pair in ring(n, 1)),
        *(Gate("RX", (wire,), (w[wire % 3],)) for wire in range(n)),  # three weights shared by all wires
    )
    sums = Hamiltonian((0.5, *(1.0 for _ in range(n))), ((), *(((wire, "Z"),) for wire in range(n))))
    first = Probabilities((0,))
    circuit = Circuit("closed", n, operations=operations, observables=(sums, first, ((5, "Z"),)), weights=(w,))
    x, weights = inputs(circuit)

    def closed(x: Tensor, weights: Tensor) -> Tensor:
        a = weights[torch.arange(n) % 3]
        neighbours = x.roll(1, 1).cos() * x.roll(-1, 1).cos()
        z = a.cos() * x.cos() - a.sin() * x.sin() * neighbours
        return torch.stack([0.5 + z.sum(1), (1 + z[:, 0]) / 2, (1 - z[:, 0]) / 2, z[:, 5]], 1)

    expected = results(closed, x, weights)
    assert_same(results(Simulator(circuit), x, weights), expected)
    assert_same(results(Simulator(circuit, backend="torch"), x, weights), expected)
    layer = QuantumLayer(circuit)
    assert layer(x.float()).dtype == torch.float32
    assert layer.cost(3).reason.endswith(f", {len(registers(circuit))} registers of at most 6 wires")


def test_amplitudes_and_unused_wires_stay_whole() -> None:
    gates = (Amplitudes((3, 20), (feature(0), 1.0, 0.3, feature(1))), Gate("CNOT", (20, 21)), Gate("H", (0,)))
    circuit = Circuit("start", 30, operations=gates, observables=(((21, "Z"),), ((0, "X"),), ((7, "Z"),)), features=2)
    x, weights = inputs(circuit)
    found = Simulator(circuit)(x, weights)
    squares = torch.stack([x[:, 0], *(torch.full_like(x[:, 0], v) for v in (1.0, 0.3)), x[:, 1]]).square()
    expected = (squares[0] - squares[1] + squares[2] - squares[3]) / squares.sum(0)
    torch.testing.assert_close(found, torch.stack([expected, *(torch.ones(3, dtype=torch.float64),) * 2], 1))


def test_wires_that_do_not_fit_say_so() -> None:
    wide = ANSATZE.build("qiren", 64, 1)
    layer = QuantumLayer(wide, shots=10)
    assert layer(torch.zeros(2, 64)).shape == (2, 64)
    with pytest.raises(ValueError, match="circuit cnot: one state of 64 wires takes"):
        QuantumLayer(ANSATZE.build("cnot", 64, 1))
    with pytest.raises(ValueError, match="the whole state of circuit qiren: one state of 64 wires"):
        statevector.probabilities(normal_form(wide), torch.zeros(1, 64), torch.zeros(4 * 3 * 64))
