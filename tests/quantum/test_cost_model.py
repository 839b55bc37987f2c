"""The expected time of a step against times that were measured at commit 5dd4eea.

benchmarks/results/cost_model.parquet holds steps of QIREN over wires, re-uploadings and batches, cost_model_any.parquet
steps of five kinds of other circuits: medians of processor time, one thread.
"""

from typing import Any

import pandas as pd
import pytest
import torch

from qnerf.config.folders import BENCHMARKS
from qnerf.kernels.simd import VECTOR_BYTES
from qnerf.quantum import QuantumLayer
from qnerf.quantum.circuit import Amplitudes, Circuit, Gate, Hamiltonian, Probabilities, Weights, feature


@pytest.fixture(autouse=True)
def one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)


def measured(name: str) -> pd.DataFrame:
    grid = pd.read_parquet(BENCHMARKS / f"{name}.parquet")
    if set(grid["vector_bytes"]) != {VECTOR_BYTES}:
        pytest.skip("the grid was measured with vectors of another length")
    return grid


def test_the_expected_time_is_within_a_factor_of_two_on_the_saved_grid() -> None:
    grid = measured("cost_model")
    rows = grid[["wires", "spectral", "batch"]].itertuples(index=False)
    expected = [QuantumLayer(int(n), int(spectral)).cost(int(batch)).seconds for n, spectral, batch in rows]
    assert (expected / grid["seconds"]).between(0.5, 2).all()
    assert grid["seconds"].max() > 1e4 * grid["seconds"].min()  # from 1 wire to 20, from 1 sample to 32,768


def test_the_expected_time_of_any_other_circuit_is_within_a_factor_of_two() -> None:
    grid = measured("cost_model_any")
    rows = grid[["kind", "wires", "batch"]].itertuples(index=False)
    expected = [QuantumLayer(circuit_of(kind, int(n))).cost(int(batch)).seconds for kind, n, batch in rows]
    assert (expected / grid["seconds"]).between(0.5, 2).all()
    assert grid["seconds"].max() > 100 * grid["seconds"].min()  # from 1 wire to 13, from 1 sample to 8,192


def circuit_of(kind: str, n: int) -> Circuit:
    """A circuit of the grid: few rotations, many, products of features, probabilities, amplitudes of features."""
    w = Weights("w", (3, n, 3))
    angles = [Gate("RX", wire, feature(wire)) for wire in range(n)]
    ring = [Gate("CNOT", (wire, (wire + 1) % n)) for wire in range(n) if n > 1]
    z: tuple[Any, ...] = tuple(((wire, "Z"),) for wire in range(n))
    layers = [[*(Gate("Rot", wire, w[layer, wire]) for wire in range(n)), *ring] for layer in range(3)]
    turned = [[*(Gate("RY", wire, w[layer, wire, 0]) for wire in range(n)), *ring] for layer in range(3)]
    operations: list[Any] = [*angles, *ring, *turned[0]]
    features = n
    if kind == "strong":
        operations = [*layers[0], *angles, *layers[1], *layers[2]]
    elif kind == "iqp":
        pairs = [Gate("IsingZZ", (a, b), feature(a) * feature(b)) for a in range(n) for b in range(a)]
        hadamards = [Gate("H", wire) for wire in range(n)]
        operations = [*hadamards, *angles, *pairs, *hadamards, *angles, *pairs, *turned[0]]
        words = [((0, "Z"),), *(((wire, "Z"), (wire + 1, "X")) for wire in range(n - 1))]
        z = (Hamiltonian([1.0] * n, words),)  # type: ignore[arg-type]
    elif kind == "probabilities":
        operations, z = [*angles, *turned[0], *turned[1], *turned[2]], (Probabilities(tuple(range(n))),)
    elif kind == "amplitudes":
        features, z = 2**n, z[:1]
        operations = [Amplitudes(tuple(range(n)), tuple(map(feature, range(2**n)))), *layers[0], *layers[1]]
    return Circuit(kind, n, operations=tuple(operations), observables=z, features=features, weights=(w,))
