"""The speed of the quantum layer and of PennyLane on the same circuit: `python -m benchmarks.quantum`.

One table is printed and saved as benchmarks/results/quantum.parquet: forward + backward of QIREN on 8 wires in float32,
medians, and errors against float64 default.qubit. Rows of the file that are not measured again stay.
"""

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import pandas as pd
import torch

from qnerf.quantum import QuantumLayer

RESULTS = Path(__file__).parent / "results" / "quantum.parquet"
WIRES, CHECKED = 8, 256  # samples whose errors are measured
ENGINES = ("auto", "lightcone", "lightcone torch", "statevector", "statevector torch")
PENNYLANE = "pennylane default.qubit torch"
Arrays = dict[str, np.ndarray]
Results = tuple[Any, Any, Any]
"""Outputs, gradients of the inputs and of the weights, as arrays or tensors."""


def inputs(spectral: int, batch: int) -> Arrays:
    """Inputs x (B, n), angles w (2 (S + 1), n, 3) and the gradient g (B, n) of the outputs."""
    random = np.random.default_rng(0)
    return {
        "x": random.standard_normal((batch, WIRES)).astype(np.float32),
        "w": (random.random((2 * (spectral + 1), WIRES, 3)) * 2 * np.pi).astype(np.float32),
        "g": random.standard_normal((batch, WIRES)).astype(np.float32),
    }


def first(data: Arrays, count: int) -> Arrays:
    return {key: array if key == "w" else array[:count] for key, array in data.items()}


def our_step(engine: str, data: Arrays, spectral: int) -> Callable[[], Results]:
    """One forward + backward of one of `ENGINES`. "torch": the plain PyTorch reference."""
    method, _, backend = engine.partition(" ")
    layer = QuantumLayer(WIRES, spectral, method=method, backend=backend or "auto")  # type: ignore[arg-type]
    x, w, g = (torch.from_numpy(data[key]) for key in "xwg")
    x = x.requires_grad_()
    with torch.no_grad():
        layer.weights1.copy_(w[:-2].reshape(layer.weights1.shape))
        layer.weights2.copy_(w[-2:])

    def step() -> Results:
        x.grad = None
        layer.zero_grad()
        y = layer(x)
        y.backward(g)
        dw = [torch.as_tensor(weights.grad) for weights in (layer.weights1, layer.weights2)]
        return y.detach(), x.grad, torch.cat([dw[0].flatten(0, 1), dw[1]])

    return step


def timed(step: Callable[[], Any], repeats: int) -> list[float]:
    """Seconds of each call after two that do not count: `repeats` of them, more of short ones, fewer of long ones."""
    step()
    step()
    times: list[float] = []
    while len(times) < repeats or (len(times) < 20 * repeats and sum(times) < 2):
        start = time.perf_counter()
        step()
        times.append(time.perf_counter() - start)
        if sum(times) > 20 and len(times) >= 3:
            break
    return times


def pennylane_step(data: Arrays, spectral: int) -> Callable[[], Results]:
    """One forward + backward of the circuit in PennyLane, written as its users would."""
    import pennylane as qml

    @qml.qnode(qml.device("default.qubit", wires=WIRES), interface="torch", diff_method="backprop")
    def circuit(x: torch.Tensor, w: torch.Tensor) -> Any:
        for block in range(spectral + 1):
            for layer in range(2):
                for wire in range(WIRES):
                    qml.Rot(*w[2 * block + layer, wire], wires=wire)
                for wire in range(WIRES):
                    qml.CZ(wires=(wire, (wire + layer + 1) % WIRES))
            for wire in range(WIRES) if block < spectral else ():
                qml.RZ(x[:, wire], wires=wire)
        return [qml.expval(qml.PauliZ(wire)) for wire in range(WIRES)]

    x, w, g = (torch.from_numpy(data[key]) for key in "xwg")

    def step() -> Results:
        inputs, angles = x.clone().requires_grad_(), w.clone().requires_grad_()
        y = torch.stack(tuple(circuit(inputs, angles)), -1)
        y.backward(g.to(y.dtype))
        return y.detach(), inputs.grad, angles.grad

    return step


def exact_results(data: Arrays, spectral: int) -> Results:
    """float64 default.qubit on the first samples."""
    return pennylane_step({key: array.astype(np.float64) for key, array in first(data, CHECKED).items()}, spectral)()


def errors(result: Results, exact: Results) -> dict[str, float]:
    """Largest absolute error of outputs and input gradients; of weight gradients relative to the largest of them."""
    outputs, inputs, weights = (
        np.abs(np.asarray(part, np.float64) - np.asarray(true)).max() for part, true in zip(result, exact, strict=True)
    )
    largest = np.abs(np.asarray(exact[2])).max()
    return {"error_outputs": float(outputs), "error_inputs": float(inputs), "error_weights": float(weights / largest)}


def measured(engine: str, spectral: int, data: Arrays, exact: Results, repeats: int) -> dict[str, Any]:
    def step_of(some: Arrays) -> Callable[[], Results]:
        return pennylane_step(some, spectral) if engine == PENNYLANE else our_step(engine, some, spectral)

    times = timed(step_of(data), repeats)
    row = {"ms": 1e3 * median(times), "ms_min": 1e3 * min(times), "repeats": len(times), "note": ""}
    return row | errors(step_of(first(data, CHECKED))(), exact)


def comparison(options: argparse.Namespace) -> pd.DataFrame:
    rows: list[dict[str, Any]] = []
    for spectral in (1, 2, 4):
        data = inputs(spectral, options.batch)
        exact = exact_results(data, spectral)
        for name in (*ENGINES, PENNYLANE):
            if name.startswith("lightcone") and spectral > 1:  # every output depends on every input
                continue
            row = {"engine": name if name == PENNYLANE else f"qnerf {name}"}
            row |= measured(name, spectral, data, exact, options.repeats)
            rows.append(row | {"S": spectral, "wires": WIRES, "batch": options.batch})
            print(f"S={spectral} {row['engine']}: {row['ms']:.2f} ms", flush=True)
    table = pd.DataFrame(rows)
    auto = table[table["engine"] == "qnerf auto"].set_index("S")
    return table.assign(
        times_slower=table["ms"] / table["S"].map(auto["ms"]),
        times_slower_min=table["ms_min"] / table["S"].map(auto["ms_min"]),  # on a busy machine the fairer figure
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=6144, help="samples of the comparison")
    parser.add_argument("--repeats", type=int, default=7, help="timed steps; the median counts")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    table = comparison(options)
    print(table.to_string(index=False, float_format=lambda value: f"{value:.3g}"))
    table = table.assign(threads=options.threads, load=os.getloadavg()[0])
    if RESULTS.exists():
        old = pd.read_parquet(RESULTS)
        table = pd.concat([table, old[~old["engine"].isin(table["engine"])]], ignore_index=True)
    table.to_parquet(RESULTS, index=False)


if __name__ == "__main__":
    main()
