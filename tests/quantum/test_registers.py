"""Wide circuits as registers, against the state of all wires where that fits, else against closed forms."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings

from qnerf.quantum.circuit import ANSATZE
from qnerf.quantum.layer import QuantumLayer
from qnerf.quantum.registers import is_split, registers
from qnerf.quantum.simulator import Simulator
from qnerf.quantum.statevector import PlainCircuit, gate_by_gate
from tests.helpers.circuits import any_circuits
from tests.quantum.test_engines import assert_same, results


@settings(max_examples=20)
@given(circuit=any_circuits)
def test_registers_of_a_circuit_give_what_the_whole_gives(circuit):
    simulator = Simulator(circuit, "statevector")
    assert_same(results(simulator.of_registers, circuit), results(simulator, circuit), 1e-12, 1e-11)


def test_polynomials_of_a_wide_circuit_are_those_of_its_registers():
    for name in ("qiren", "rx"):
        circuit = ANSATZE.build(name, 14, 1)
        circuit = replace(circuit, observables=(*circuit.observables, ()))  # the identity, which has no cone
        assert is_split(circuit)
        expected = results(PlainCircuit(circuit).evaluate, circuit, batch=2)
        for options in (("lightcone",), ("statevector",), ("lightcone", "torch")):
            assert_same(results(Simulator(circuit, *options), circuit, batch=2), expected, 1e-12, 1e-11)


def test_output_of_64_wires_sees_what_a_smaller_ring_sees():
    """Output 30 of 64 wires depends on wires 26..34 alone. A ring of 12 wires looks the same to it."""
    wide, near = ANSATZE.build("qiren", 64, 1), slice(24, 36)
    assert {part.circuit.wires for part in registers(wide)} == {9}
    ring, simulator = Simulator(ANSATZE.build("qiren", 12, 1), "statevector"), Simulator(wide, "lightcone")
    expected = results(lambda x, w: ring(x[:, near], w.reshape(4, 64, 3)[:, near].flatten())[:, 6], wide, batch=200)
    assert_same(results(lambda x, w: simulator(x, w)[:, 30], wide, batch=200), expected, 1e-12, 1e-11)
    cost = QuantumLayer(wide).cost(6144)
    assert cost.method == "lightcone"
    assert cost.memory < 2**28


def test_circuits_that_do_not_fit_say_so():
    wide = ANSATZE.build("qiren", 64, 1)
    layer = QuantumLayer(wide, shots=10)
    assert layer(torch.zeros(2, 64)).shape == (2, 64)
    with pytest.raises(ValueError, match="circuit cnot: one state of 64 wires takes"):
        QuantumLayer(ANSATZE.build("cnot", 64, 1))
    with pytest.raises(ValueError, match="the whole state of circuit qiren: one state of 64 wires"):
        gate_by_gate(wide, torch.zeros(1, 64), torch.zeros(4 * 3 * 64))
