"""The speed of the quantum layer and of other packages on the same circuit: `python -m benchmarks.quantum`.

One table is printed and saved as benchmarks/results/quantum.parquet: forward + backward of QIREN on 8 wires in float32,
medians, and errors against float64 default.qubit. Each peer runs in a process of its own, with this interpreter or with
that of another environment (`--peers-python`). A peer that does not run is listed with its error. Rows of the file that
are not measured again stay.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import pandas as pd
import torch

from benchmarks.peers.circuits import PEERS, pennylane_torch
from qnerf.quantum import QuantumLayer

RESULTS = Path(__file__).parent / "results" / "quantum.parquet"
ROOT = Path(__file__).parents[1]
WIRES, CHECKED = 8, 256  # samples whose errors are measured
ENGINES = ("auto", "lightcone", "lightcone torch", "statevector", "statevector torch")
Arrays = dict[str, np.ndarray]
Results = tuple[Any, Any, Any]
"""Outputs, gradients of the inputs and of the weights."""


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


def exact_results(data: Arrays, spectral: int) -> Results:
    """float64 default.qubit on the first samples."""
    step = pennylane_torch(WIRES, spectral)
    return step(*(array.astype(np.float64) for array in first(data, CHECKED).values()))


def errors(result: Results, exact: Results) -> dict[str, float]:
    """Largest absolute error of outputs and input gradients; of weight gradients relative to the largest of them.

    Gradients of weights are sums over samples: they are compared where both sides have the same samples.
    """
    y, dx, dw = (np.asarray(part, dtype=np.float64) for part in result)
    samples = min(len(y), len(exact[0]))
    row = {
        "error_outputs": float(np.abs(y[:samples] - exact[0][:samples]).max()),
        "error_inputs": float(np.abs(dx[:samples] - exact[1][:samples]).max()),
    }
    if len(y) == len(exact[0]):
        row["error_weights"] = float(np.abs(dw - exact[2]).max() / np.abs(exact[2]).max())
    return row


def ours(engine: str, spectral: int, data: Arrays, exact: Results, repeats: int) -> dict[str, Any]:
    times = timed(our_step(engine, data, spectral), repeats)
    row = {"ms": 1e3 * median(times), "ms_min": 1e3 * min(times), "repeats": len(times), "note": ""}
    return row | errors(our_step(engine, first(data, CHECKED), spectral)(), exact)


def peer(name: str, data: Arrays, exact: Results, options: argparse.Namespace) -> dict[str, Any]:
    """A row without times where the peer does not run."""
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "in.npz", Path(folder) / "out.npz"
        np.savez(source, **data)  # type: ignore[arg-type]
        command = [options.peers_python, "-m", "benchmarks.peers.run", name, str(source), str(target)]
        environment = dict(os.environ, OMP_NUM_THREADS=str(options.threads))
        try:
            done = subprocess.run(
                [*command, str(options.repeats), str(options.threads)],
                capture_output=True, text=True, cwd=ROOT, env=environment, timeout=options.timeout, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return {"note": f"no result within {options.timeout} s"}
        if done.returncode != 0:
            lines = [line for line in done.stderr.splitlines() if line.strip()]
            return {"note": (lines[-1] if lines else f"exit code {done.returncode}")[:200]}
        result = np.load(target)
        about = json.loads(str(result["about"]))
        scaled = f"; {result['samples']} samples, scaled up" if result["samples"] < len(data["x"]) else ""
        note = f"{about['version']}; first call {about['first']:.1f} s{scaled}"
        times = about["times"]
        row = {"ms": 1e3 * median(times), "ms_min": 1e3 * min(times), "repeats": len(times), "note": note}
        return row | errors((result["y"], result["dx"], result["dw"]), exact)


def comparison(options: argparse.Namespace) -> pd.DataFrame:
    rows: list[dict[str, Any]] = []
    for spectral in (1, 2, 4):
        data = inputs(spectral, options.batch)
        exact = exact_results(data, spectral)
        for name in (*ENGINES, *options.peers):
            if name.startswith("lightcone") and spectral > 1:  # every output depends on every input
                continue
            if name in ENGINES:
                row = {"engine": f"qnerf {name}"} | ours(name, spectral, data, exact, options.repeats)
            else:
                row = {"engine": name} | peer(name, data, exact, options)
            rows.append(row | {"S": spectral, "wires": WIRES, "batch": options.batch})
            print(f"S={spectral} {row['engine']}: {row.get('ms', float('nan')):.2f} ms {row['note']}", flush=True)
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
    parser.add_argument("--peers-python", default=sys.executable, help="interpreter of the environment with the peers")
    parser.add_argument("--peers", nargs="*", default=list(PEERS), choices=list(PEERS), metavar="NAME")
    parser.add_argument("--timeout", type=float, default=600, help="seconds for one peer and one S")
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
