"""QuantumLayer as users meet it."""

import re
from math import prod
from pathlib import Path

import pytest
import torch
from torch.profiler import profile

from qnerf.config import memory
from qnerf.quantum.circuit import ANSATZE
from qnerf.quantum.initial_angles import INITS
from qnerf.quantum.layer import QuantumLayer


def run_examples(page):
    """A page of docs/, and the names that its Python examples define."""
    text = (Path(__file__).parents[2] / "docs" / page).read_text()
    names = {}
    for example in re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        exec(example, names)
    return text, names


def test_examples_of_the_page_run(monkeypatch, capsys):
    monkeypatch.setattr(ANSATZE, "_components", dict(ANSATZE._components))  # the page registers one
    page, names = run_examples("quantum.md")
    assert names["values"].shape == (6144, 64)
    drawing = [line.rstrip() for line in capsys.readouterr().out.splitlines() if line[1:5] == ": ──"]
    assert "\n".join(drawing) in page


def test_examples_of_the_pages_on_hardware_and_diagnostics_run():
    assert run_examples("hardware.md")[1]["noisy"].shape == (64, 8)
    assert run_examples("diagnostics.md")[1]["matrix"].shape == (72, 72)


def test_parameters_have_the_published_names_and_shapes():
    shapes = {name: tuple(value.shape) for name, value in QuantumLayer(8, 3).state_dict().items()}
    assert shapes == {"weights1": (3, 2, 8, 3), "weights2": (2, 8, 3)}


def test_auto_picks_by_cost():
    assert QuantumLayer(8, 1).cost(6144).method == "lightcone"
    assert QuantumLayer(8, 1).cost(4).method == "statevector"  # a few samples do not pay for the grid
    assert QuantumLayer(1, 3).cost(80000).method == "lightcone"
    cost = QuantumLayer(8, 2).cost(6144)
    assert cost.method == "statevector"
    assert "depends on 8 inputs" in cost.reason
    assert "statevector (compiled) for 6144 samples" in str(cost)
    assert cost.operations > QuantumLayer(8, 1).cost(6144).operations
    assert QuantumLayer(8, 2, backend="torch").cost().backend == "torch"


def test_cost_of_a_grid_too_large_to_interpolate_on_is_one_line():
    """Small cones that few wires share a colour in: 19,683 points for 243 coefficients."""
    options = {"ranges": (1, 1), "observable": "X"}
    cost = QuantumLayer(9, 1, ansatz_options=options).cost(100)
    assert cost.method == "statevector"
    assert "interpolation grid of 19,683 points" in cost.reason
    with pytest.raises(ValueError, match="choose method=statevector or auto"):
        QuantumLayer(9, 1, method="lightcone", ansatz_options=options)


def test_initial_angles_follow_the_seed_and_eighth_moves_more_than_uniform():
    x = torch.randn(256, 8)
    spread = {}
    for name in INITS.names():
        torch.manual_seed(5)
        first = QuantumLayer(8, 2, init=name)
        torch.manual_seed(5)
        second = QuantumLayer(8, 2, init=name)
        assert torch.equal(first.weights1, second.weights1)
        assert torch.equal(first.weights2, second.weights2)
        assert not torch.equal(second.weights1, QuantumLayer(8, 2, init=name).weights1)
        spread[name] = sum(QuantumLayer(8, 2, init=name)(x).std(0).mean().item() for _ in range(8))
    assert spread["eighth"] > 1.5 * spread["uniform"]


MISTAKES = [
    ((0, 1), {}, r"wires must be an integer in 1..1024, got 0"),
    ((21, 4), {}, r"circuit qiren: one state of 21 wires takes 32 MiB"),
    ((40, 4), {}, r"depends on 27 of its 40 wires: one state of 27 wires takes 2 GiB of memory.*at most 20"),
    ((21, 1), {"method": "pennylane"}, "device default.qubit: one state of 21 wires takes 32 MiB"),
    ((2.0, 1), {}, "wires expects int or Circuit, got 2.0"),
    ((3, 0), {}, "spectral must be between 1 and 64, got 0"),
    ((3,), {}, "spectral is missing"),
    ((ANSATZE.build("qiren", 3, 2), 2), {}, "spectral belongs to the circuit qiren, which is given, got spectral=2"),
    ((3, 1), {"method": "exact"}, "method expects one of auto, lightcone, statevector, pennylane, got 'exact'"),
    ((3, 1), {"ansatz": "q"}, "ansatz: unknown name 'q'; known: cnot"),
    ((3, 1), {"ansatz_options": {"ranges": (3, 1)}}, "none a multiple of 3"),
    ((3, 1), {"ansatz_options": {"ranges": (1,)}}, "needs 2 distances"),
    ((3, 1), {"init": "zero"}, "init: unknown name 'zero'; known: eighth, uniform"),
    ((8, 2), {"method": "lightcone"}, "depends on 8 inputs.*choose method=statevector or auto"),
]


def test_mistakes_in_arguments_and_inputs_are_one_line():
    for arguments, options, message in MISTAKES:
        with pytest.raises(ValueError, match=message) as error:
            QuantumLayer(*arguments, **options)
        assert "\n" not in str(error.value)
    layer = QuantumLayer(3, 1)
    for x, message in (
        (torch.zeros(4, 2), r"expects shape \(..., 3\), got \(4, 2\)"),
        (torch.zeros(()), r"expects shape \(..., 3\), got \(\)"),
        (torch.zeros(4, 3, dtype=torch.int64), "angles in radians, got a tensor of torch.int64"),
        (torch.zeros(4, 3, dtype=torch.complex64), "got a tensor of torch.complex64"),
    ):
        with pytest.raises(ValueError, match=message):
            layer(x)


def test_memory_for_a_circuit_is_checked_before(monkeypatch):
    layer = QuantumLayer(16, 2)
    monkeypatch.setattr(memory, "available_bytes", lambda: 2**28)
    with pytest.raises(ValueError, match=r"a circuit of 20 wires would take .* of memory; 256 MiB are available"):
        QuantumLayer(20, 2)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 64)
    with pytest.raises(ValueError, match=r"a batch of 10000 samples of a circuit of 16 wires would take"):
        layer(torch.zeros(10000, 16))


@pytest.mark.parametrize("options", [{"spectral": 1}, {"spectral": 2}, {"spectral": 1, "ansatz": "pauli_x"}])
def test_pytorch_computes_nothing_large_beside_the_loops(options):
    """Its threads would be woken for more than 32,768 numbers, and spin afterwards."""
    layer = QuantumLayer(8, **options)
    x = torch.randn(5000, 8, requires_grad=True)
    upstream = torch.ones_like(layer(x))
    with profile(record_shapes=True) as profiler:
        torch.autograd.backward(layer(x), upstream)
    large = {e.name for e in profiler.events() if any(prod(shape) > 32_768 for shape in e.input_shapes if shape)}
    of_memory = {"new_empty", "new_zeros", "to", "detach", "lift_fresh", "resolve_conj", "resolve_neg", "view"}
    assert {name for name in large if name.startswith("aten::")} <= {f"aten::{name}" for name in of_memory}
