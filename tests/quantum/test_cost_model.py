"""The expected time of a step against the times that were measured."""

import pandas as pd
import pytest
import torch

from benchmarks.cost_model import RESULT, RESULT_ANY, circuit_of, expected, expected_any
from qnerf.kernels.simd import VECTOR_BYTES
from qnerf.quantum import QuantumLayer, pauli_cost
from qnerf.quantum.cost_model import RATES


def test_the_expected_time_is_within_a_factor_of_two_on_the_saved_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    grid = pd.read_parquet(RESULT)
    if set(grid["vector_bytes"]) != {VECTOR_BYTES}:
        pytest.skip("the grid was measured with vectors of another length")
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    ratio = expected(grid, RATES) / grid["seconds"]
    assert ratio.between(0.5, 2).all()
    assert grid["seconds"].max() > 1e4 * grid["seconds"].min()  # from 1 wire to 20, from 1 sample to 32,768


def test_so_is_that_of_any_other_circuit(monkeypatch: pytest.MonkeyPatch) -> None:
    grid = pd.read_parquet(RESULT_ANY)
    if set(grid["vector_bytes"]) != {VECTOR_BYTES}:
        pytest.skip("the grid was measured with vectors of another length")
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    ratio = expected_any(grid, pauli_cost.RATES) / grid["seconds"]
    assert ratio.between(0.5, 2).all()
    assert grid["seconds"].max() > 100 * grid["seconds"].min()  # from 1 wire to 13, from 1 sample to 8,192
    last = grid.iloc[-1]
    layer = QuantumLayer(circuit_of(last["kind"], int(last["wires"])))
    assert layer.cost(int(last["batch"])).seconds == pytest.approx(ratio.iloc[-1] * last["seconds"])
