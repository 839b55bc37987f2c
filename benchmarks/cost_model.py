"""Fits the constants of the cost model to this machine: `python -m benchmarks.cost_model`.

Times a step of QIREN (forward and backward, float32, one thread) over wires, re-uploadings and batches, and saves the
grid in benchmarks/results/cost_model.parquet. The times are medians of processor time, which other programs on a busy
machine disturb little. It prints `Rates` for `qnerf.quantum.cost_model`, and how far off the fit is at most. A few
minutes; the largest circuits take 3 GiB.
"""

import argparse
import time
from collections.abc import Iterable
from dataclasses import astuple, fields
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import pandas as pd
import torch
from scipy.optimize import least_squares

from qnerf.quantum.circuit import ANSATZE
from qnerf.quantum.compiled.simd import VECTOR_BYTES
from qnerf.quantum.cost_model import Rates, choose_engine, expected_seconds, forms_of
from qnerf.quantum.layer import QuantumLayer

RESULT = Path(__file__).parent / "results" / "cost_model.parquet"
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
    x = torch.randn(batch, layer.wires, requires_grad=True)
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


def expected(grid: pd.DataFrame, rates: Rates) -> np.ndarray:
    """Expected seconds of each row."""
    seconds = []
    for wires, spectral, batch in grid[["wires", "spectral", "batch"]].itertuples(index=False):
        circuit = ANSATZE.build("qiren", int(wires), int(spectral))
        cost = choose_engine(circuit, "auto", int(batch), torch.float32, compiled=True)
        counts = cost.operations, cost.operations_once
        seconds.append(expected_seconds(forms_of(circuit), circuit.wires, cost.batch, 4, *counts, rates))
    return np.array(seconds)


def fit(grid: pd.DataFrame) -> Rates:
    """The constants with the least error of the logarithm."""

    def off(logarithms: np.ndarray) -> np.ndarray:
        return np.asarray(np.log(expected(grid, Rates(*np.exp(logarithms))) / grid["seconds"]))

    return Rates(*np.exp(least_squares(off, np.log(astuple(Rates())), loss="soft_l1").x))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--saved", action="store_true", help="fit to the saved grid instead of measuring a new one")
    options = parser.parse_args()
    torch.set_num_threads(1)
    circuits = [*product(WIRES, SPECTRAL), *product(WIDE, [1])]
    grid = pd.read_parquet(RESULT) if options.saved else measure(circuits)
    if not options.saved:
        grid.to_parquet(RESULT)
    rates = fit(grid)
    ratios = expected(grid, rates) / grid["seconds"]
    print(", ".join(f"{field.name}={getattr(rates, field.name):.3g}" for field in fields(rates)))
    print(f"expected / measured: {ratios.min():.2f} to {ratios.max():.2f} over {len(grid)} cases")


if __name__ == "__main__":
    main()
