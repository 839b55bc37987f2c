"""Fits the constants of the cost model to this machine: `python -m benchmarks.cost_model`.

Times a step of QIREN (forward and backward, float32, one thread) over wires, re-uploadings and batches, and saves the
grid in benchmarks/results/cost_model.parquet. The times are medians of processor time, which other programs on a busy
machine disturb little. It prints `Rates` for `qnerf.quantum.cost_model`, and how far off the fit is at most. A few
minutes; the largest circuits take 3 GiB.

With `--any` it times other circuits, each three times with all others in between, and takes the least. It saves
cost_model_any.parquet and prints `PauliRates` for `qnerf.quantum.pauli_cost`.
"""

import argparse
import time
from collections.abc import Callable, Iterable
from dataclasses import astuple, fields
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import pandas as pd
import torch
from scipy.optimize import least_squares

from qnerf.kernels.simd import VECTOR_BYTES
from qnerf.quantum import pauli_cost
from qnerf.quantum.circuit import ANSATZE, Amplitudes, Circuit, Gate, Hamiltonian, Probabilities, Weights, feature
from qnerf.quantum.cost_model import Rates, choose_engine, expected_seconds, forms_of
from qnerf.quantum.layer import QuantumLayer
from qnerf.quantum.pauli_cost import PauliRates
from qnerf.quantum.pauli_form import pauli_form

RESULT = Path(__file__).parent / "results" / "cost_model.parquet"
RESULT_ANY = Path(__file__).parent / "results" / "cost_model_any.parquet"
KINDS = ("shallow", "strong", "iqp", "probabilities", "amplitudes")
WIRES = (1, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20)
SPECTRAL = (1, 2, 4)
WIDE = (32, 64)  # wires, with S = 1
BATCHES = (1, 16, 100, 1024, 6144, 32768)
MOST_OPERATIONS, MOST_MEMORY = 7.5e10, 3e9  # of a step


def measure(circuits: Iterable[tuple[int, int]]) -> pd.DataFrame:
    """Seconds of a step for each case; circuits: wires and S of each."""
    rows: list[dict[str, Any]] = []
    for wires, spectral in circuits:
        layer = QuantumLayer(wires, spectral)
        for batch in BATCHES:
            cost = layer.cost(batch)
            if cost.operations * max(batch, 16) + 2 * cost.operations_once > MOST_OPERATIONS:
                continue
            if cost.memory > MOST_MEMORY:
                continue
            row = {"wires": wires, "spectral": spectral, "batch": batch, "seconds": seconds_of(layer, batch)}
            rows.append(row | {"vector_bytes": VECTOR_BYTES})
            print(row, flush=True)
    return pd.DataFrame(rows)


def seconds_of(layer: QuantumLayer, batch: int) -> float:
    x = torch.randn(batch, layer.circuit.features or 0, requires_grad=True)
    layer(x).sum().backward()
    times: list[float] = []
    begun = time.perf_counter()
    while len(times) < 3 or (len(times) < 30 and time.perf_counter() - begun < 0.4):
        start = time.process_time()
        x.grad = None
        layer.zero_grad()
        layer(x).sum().backward()
        times.append(time.process_time() - start)
        if time.perf_counter() - begun > 20:
            break
    return median(times)


def circuit_of(kind: str, n: int) -> Circuit:
    """One of `KINDS` on n wires: few rotations, many, products of features, probabilities, amplitudes of features."""
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


def measure_any() -> pd.DataFrame:
    """Seconds of a step of other circuits."""
    cases = [(kind, wires) for kind in KINDS for wires in (1, 3, 6, 8, 10, 13) if kind != "amplitudes" or wires <= 8]
    layers = {case: QuantumLayer(circuit_of(*case)) for case in cases}
    rows: dict[tuple[str, int, int], float] = {}
    for _ in range(3):
        for ((kind, wires), layer), batch in product(layers.items(), (1, 100, 1024, 8192)):
            if layer.cost(batch).operations * batch < 5e9:
                seconds = seconds_of(layer, batch)
                rows[kind, wires, batch] = min(seconds, rows.get((kind, wires, batch), seconds))
                print(kind, wires, batch, seconds, flush=True)
    frame = pd.DataFrame(
        [(*case, seconds) for case, seconds in rows.items()], columns=["kind", "wires", "batch", "seconds"]
    )
    return frame.assign(vector_bytes=VECTOR_BYTES)


def expected_any(grid: pd.DataFrame, rates: PauliRates) -> np.ndarray:
    """Expected seconds of each row."""
    rows = grid[["kind", "wires", "batch"]].itertuples(index=False)
    return np.array(
        [pauli_cost.expected_seconds(pauli_form(circuit_of(k, int(n))), int(b), 4, rates) for k, n, b in rows]
    )


def expected(grid: pd.DataFrame, rates: Rates) -> np.ndarray:
    """Expected seconds of each row."""
    seconds = []
    for wires, spectral, batch in grid[["wires", "spectral", "batch"]].itertuples(index=False):
        circuit = ANSATZE.build("qiren", int(wires), int(spectral))
        cost = choose_engine(circuit, "auto", int(batch), torch.float32, compiled=True)
        counts = cost.operations, cost.operations_once
        seconds.append(expected_seconds(forms_of(circuit), circuit.wires, cost.batch, 4, *counts, rates))
    return np.array(seconds)


Model = Callable[[pd.DataFrame, Any], np.ndarray]


def fit(grid: pd.DataFrame, model: Model, first: Any) -> Any:
    """The constants with the least error of the logarithm, from the constants `first`."""

    def off(logarithms: np.ndarray) -> np.ndarray:
        return np.asarray(np.log(model(grid, type(first)(*np.exp(logarithms))) / grid["seconds"]))

    return type(first)(*np.exp(least_squares(off, np.log(astuple(first)), loss="soft_l1").x))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--saved", action="store_true", help="fit to the saved grid instead of measuring a new one")
    parser.add_argument("--any", action="store_true", help="circuits that are no re-uploading circuits")
    options = parser.parse_args()
    torch.set_num_threads(1)
    result, model, first = (RESULT_ANY, expected_any, PauliRates()) if options.any else (RESULT, expected, Rates())
    if options.saved:
        grid = pd.read_parquet(result)
    else:
        grid = measure_any() if options.any else measure([*product(WIRES, SPECTRAL), *product(WIDE, [1])])
        grid.to_parquet(result)
    rates = fit(grid, model, first)  # type: ignore[arg-type]
    ratios = model(grid, rates) / grid["seconds"]  # type: ignore[operator]
    print(", ".join(f"{field.name}={getattr(rates, field.name):.3g}" for field in fields(rates)))
    print(f"expected / measured: {ratios.min():.2f} to {ratios.max():.2f} over {len(grid)} cases")


if __name__ == "__main__":
    main()
