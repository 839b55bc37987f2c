"""How gradients vanish with wires and depth: `python -m benchmarks.plateaus`.

Measures the variance of d<Z_0>/d theta over random circuits, with theta the angle of one RY in the middle of the
circuit (arXiv:1803.11173). If it falls exponentially with the wires, the circuit cannot be trained from random angles.
Saved as benchmarks/results/plateaus.parquet, one row for each ansatz, start, number of wires and depth.
"""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import torch
from torch import Tensor

from qnerf.quantum.circuit import ANSATZE
from qnerf.quantum.compiled import engine as compiled
from qnerf.quantum.initial_angles import INITS
from qnerf.quantum.normal_form import THETA, normal_form

RESULTS = Path(__file__).parent / "results" / "plateaus.parquet"
WIRES = tuple(range(2, 13))
DEPTHS = tuple(range(1, 9))


def gradients(ansatz: str, init: str, wires: int, spectral: int, circuits: int) -> Tensor:
    """d<Z_0>/d theta, (circuits,) float64, for random angles and one standard normal input each.

    theta is the angle of wire 0 in the first sublayer of the middle block. Every call draws the same circuits.
    """
    circuit = ANSATZE.build(ansatz, wires, spectral)
    engine = compiled.StatevectorEngine(normal_form(circuit))
    row = circuit.rows // 2
    samples = []
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(wires * 1000 + spectral)
        for _ in range(circuits):
            weights = INITS.get(init)(circuit).double().requires_grad_()
            outputs = compiled.evaluate(engine, torch.randn(1, wires, dtype=torch.float64), weights)
            (gradient,) = torch.autograd.grad(outputs[0, 0], weights)
            samples.append(gradient[row, 0, THETA])
    return torch.stack(samples)


def measure(wires: Sequence[int], depths: Sequence[int], circuits: int) -> pd.DataFrame:
    """Columns ansatz, init, wires, S, circuits, variance, error (standard error of the variance)."""
    rows = []
    for init in INITS.names():
        for spectral in depths:
            for count in wires:
                sampled = gradients("qiren", init, count, spectral, circuits)
                squares = (sampled - sampled.mean()).square()
                rows.append(
                    {
                        "ansatz": "qiren",
                        "init": init,
                        "wires": count,
                        "S": spectral,
                        "circuits": circuits,
                        "variance": float(squares.mean()),
                        "error": float(squares.std()) / math.sqrt(circuits),
                    }
                )
    return pd.DataFrame(rows)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Variance of gradients against wires and depth.")
    parser.add_argument("--circuits", type=int, default=300, help="random circuits a point (default: 300)")
    parser.add_argument("--out", type=Path, default=RESULTS, metavar="FILE")
    options = parser.parse_args(arguments)
    table = measure(WIRES, DEPTHS, options.circuits)
    table.to_parquet(options.out, index=False)
    print(table.pivot(index="wires", columns=["init", "S"], values="variance").to_string(float_format="{:.1e}".format))


if __name__ == "__main__":
    main()
