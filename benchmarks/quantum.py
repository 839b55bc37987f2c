"""The speed of the quantum layer and of other packages on the same circuit: `python -m benchmarks.quantum`.

One table is printed and saved as benchmarks/results/quantum.parquet: forward + backward of QIREN in float32, medians on
2 threads, and errors against float64 default.qubit. Each peer runs in a process of its own, with this interpreter or
with that of another environment (`--peers-python`). A peer that does not run is listed with its error. A second table
is the time over batch, wires and S, beside what the machine could do at most.
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
from qnerf.quantum import lightcone, statevector
from qnerf.quantum.circuit import ANSATZE
from qnerf.quantum.compiled import engine as compiled
from qnerf.quantum.layer import QuantumLayer
from qnerf.quantum.normal_form import normal_form

RESULTS = Path(__file__).parent / "results"
ROOT = Path(__file__).parents[1]
Arrays = dict[str, np.ndarray]


def inputs(wires: int, spectral: int, batch: int) -> Arrays:
    random = np.random.default_rng(0)
    return {
        "x": random.standard_normal((batch, wires)).astype(np.float32),
        "w": (random.random((2 * (spectral + 1), wires, 3)) * 2 * np.pi).astype(np.float32),
        "g": random.standard_normal((batch, wires)).astype(np.float32),
    }


def timed(step: Callable[[], Any], repeats: int, budget: float = 20.0) -> list[float]:
    step()
    step()
    times: list[float] = []
    begin = time.perf_counter()
    while len(times) < repeats or (len(times) < 20 * repeats and time.perf_counter() - begin < 2.0):
        start = time.perf_counter()
        step()
        times.append(time.perf_counter() - start)
        if time.perf_counter() - begin > budget and len(times) >= 3:
            break
    return times


def engine_step(name: str, data: Arrays, spectral: int) -> Callable[[], tuple[torch.Tensor, ...]]:
    """One forward + backward of one of our engines: outputs and both gradients."""
    wires = data["x"].shape[1]
    circuit = ANSATZE.build("qiren", wires, spectral)
    if name == "auto":
        layer = QuantumLayer(wires, spectral)
        with torch.no_grad():
            w = torch.from_numpy(data["w"])
            layer.weights1.copy_(w[:-2].reshape(layer.weights1.shape))
            layer.weights2.copy_(w[-2:])
        x, g = torch.from_numpy(data["x"]).requires_grad_(), torch.from_numpy(data["g"])

        def whole() -> tuple[torch.Tensor, ...]:
            x.grad = layer.weights1.grad = layer.weights2.grad = None
            y = layer(x)
            y.backward(g)
            assert x.grad is not None
            assert layer.weights1.grad is not None
            assert layer.weights2.grad is not None
            return y.detach(), x.grad, torch.cat([layer.weights1.grad.flatten(0, 1), layer.weights2.grad])

        return whole
    simulator = compiled.StatevectorEngine(normal_form(circuit))
    functions: dict[str, Callable[[torch.Tensor, torch.Tensor], torch.Tensor]] = {
        "statevector": lambda x, w: compiled.evaluate(simulator, x, w),
        "statevector torch": lambda x, w: statevector.evaluate(simulator.form, x, w),
        "lightcone torch": lambda x, w: lightcone.evaluate_reference(circuit, x, w),
    }
    if name == "lightcone":
        cone = lightcone.LightConeEngine(circuit)
        functions["lightcone"] = lambda x, w: lightcone.evaluate(cone, x, w)
    function = functions[name]
    x = torch.from_numpy(data["x"]).requires_grad_()
    weights, g = torch.from_numpy(data["w"]).requires_grad_(), torch.from_numpy(data["g"])

    def step() -> tuple[torch.Tensor, ...]:
        x.grad = weights.grad = None
        y = function(x, weights)
        y.backward(g)
        assert x.grad is not None
        assert weights.grad is not None
        return y.detach(), x.grad, weights.grad

    return step


def reference(data: Arrays, spectral: int, samples: int) -> tuple[np.ndarray, ...]:
    """float64 default.qubit on the first samples: outputs, gradients of the inputs and of the weights."""
    step = pennylane_torch(data["x"].shape[1], spectral)
    data = {key: (array if key == "w" else array[:samples]).astype(np.float64) for key, array in data.items()}
    return step(data["x"], data["w"], data["g"])


def errors(result: tuple[Any, ...], exact: tuple[np.ndarray, ...]) -> dict[str, float]:
    """Largest absolute error of outputs and input gradients; of weight gradients relative to the largest of them."""
    samples = len(exact[0])
    y, dx, dw = (np.asarray(part, dtype=np.float64) for part in result)
    row = {
        "error_outputs": float(np.abs(y[:samples] - exact[0]).max()),
        "error_inputs": float(np.abs(dx[:samples] - exact[1]).max()),
    }
    if len(y) == samples:
        row["error_weights"] = float(np.abs(dw - exact[2]).max() / np.abs(exact[2]).max())
    return row


def peak_memory(name: str, spectral: int, batch: int, threads: int) -> int:
    """Growth of the resident set of a fresh process during one step, after a step on 32 samples."""
    code = (
        "import torch; from benchmarks.peers.memory import growth; from benchmarks.quantum import engine_step, inputs;"
        f"torch.set_num_threads({threads});"
        f"engine_step({name!r}, inputs(8, {spectral}, 32), {spectral})();"
        f"print(growth(engine_step({name!r}, inputs(8, {spectral}, {batch}), {spectral})))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    return int(done.stdout.split()[-1]) if done.returncode == 0 else -1


def peer(name: str, data: Arrays, options: argparse.Namespace) -> tuple[dict[str, Any], tuple[np.ndarray, ...] | None]:
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
            return {"note": f"no result within {options.timeout} s"}, None
        if done.returncode != 0:
            lines = [line for line in done.stderr.splitlines() if line.strip()]
            return {"note": (lines[-1] if lines else f"exit code {done.returncode}")[:200]}, None
        result = np.load(target)
        about = json.loads(str(result["about"]))
        samples = int(result["samples"])
        note = f"{about['version']}; first call {about['first']:.1f} s"
        if samples < len(data["x"]):
            note += f"; {samples} samples, scaled up"
        row = {
            "ms": 1e3 * median(about["times"]),
            "ms_min": 1e3 * min(about["times"]),
            "repeats": len(about["times"]),
            "memory": about["peak"],
            "note": note,
        }
        return row, (result["y"], result["dx"], result["dw"])


def machine(threads: int) -> dict[str, float]:
    """Multiply-adds a second of a float32 matrix product, and bytes a second of a copy, on this machine."""
    a, b = torch.randn(2048, 2048), torch.randn(2048, 2048)
    product = median(timed(lambda: a @ b, 7))
    source, target = torch.zeros(2**26), torch.zeros(2**26)
    copy = median(timed(lambda: target.copy_(source), 7))
    return {"threads": threads, "gmadds": 2048**3 / product / 1e9, "gbytes": 2 * source.nbytes / copy / 1e9}


def comparison(options: argparse.Namespace) -> pd.DataFrame:
    rows: list[dict[str, Any]] = []
    failed: dict[str, str] = {}
    for spectral in (1, 2, 4):
        data = inputs(8, spectral, options.batch)
        exact = reference(data, spectral, min(256, options.batch))
        small = {key: array[:256] if key != "w" else array for key, array in data.items()}
        common = {"S": spectral, "wires": 8, "batch": options.batch}
        names = [
            "auto",
            *(["lightcone", "lightcone torch"] if spectral == 1 else []),
            "statevector",
            "statevector torch",
        ]
        for name in names:
            step = engine_step(name, data, spectral)
            times = timed(step, options.repeats)
            error = errors(engine_step(name, small, spectral)(), exact)
            memory = peak_memory(name, spectral, options.batch, options.threads)
            row = {
                "engine": f"qnerf {name}",
                **common,
                "ms": 1e3 * median(times),
                "ms_min": 1e3 * min(times),
                "repeats": len(times),
                "memory": memory,
            }
            rows.append(row | error)
            print(f"S={spectral} qnerf {name}: {row['ms']:.2f} ms", flush=True)
        for name in options.peers:
            # A peer that failed at a smaller S would fail at a larger one too.
            row, result = ({"note": failed[name]}, None) if name in failed else peer(name, data, options)
            if result is None:
                failed[name] = row["note"]
            error = {}
            if result is not None:
                ran = len(result[0])
                error = errors(result, tuple(part[:ran] for part in exact[:2]) + exact[2:])
                if ran < len(exact[0]):  # the reference's gradients of the weights are sums over more samples
                    error.pop("error_weights", None)
            rows.append({"engine": name, **common} | row | error)
            print(f"S={spectral} {name}: {row.get('ms', float('nan')):.0f} ms {row['note']}", flush=True)
    table = pd.DataFrame(rows)
    ours = table[table.engine == "qnerf auto"].set_index("S")
    table["times_slower"] = table.ms / table.S.map(ours["ms"])
    table["times_slower_min"] = table.ms_min / table.S.map(ours["ms_min"])  # on a busy machine the fairer figure
    return table


def growth(options: argparse.Namespace, limits: dict[str, float]) -> pd.DataFrame:
    """Times of method auto over batch, wires and S, and the operations and bytes that are needed at least."""
    cases = [(8, spectral, 2**power) for spectral in (1, 2) for power in range(8, 18)]
    cases += [(wires, spectral, 1024) for spectral in (1, 2) for wires in range(2, 15)]
    cases += [(8, spectral, 6144) for spectral in range(1, 9)]
    rows = []
    for wires, spectral, batch in dict.fromkeys(cases):
        data = inputs(wires, spectral, batch)
        cost = QuantumLayer(wires, spectral).cost(batch)
        times = timed(engine_step("auto", data, spectral), 5, budget=4.0)
        operations = cost.operations * batch + cost.operations_once
        moved = 4 * batch * wires * 5  # inputs, outputs, gradients of both, and what forward stores for backward
        ms = 1e3 * median(times)
        row = {"wires": wires, "S": spectral, "batch": batch, "method": cost.method, "ms": ms}
        row |= {"expected_ms": cost.seconds * 1e3, "operations": operations, "bytes": moved}
        row |= {"product_ms": operations / limits["gmadds"] / 1e6, "copy_ms": moved / limits["gbytes"] / 1e6}
        rows.append(row)
        print(f"n={wires} S={spectral} B={batch}: {ms:.2f} ms", flush=True)
    return pd.DataFrame(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=6144, help="samples of the comparison")
    parser.add_argument("--repeats", type=int, default=7, help="timed steps; the median counts")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--peers-python", default=sys.executable, help="interpreter of the environment with the peers")
    parser.add_argument("--peers", nargs="*", default=list(PEERS), choices=list(PEERS), metavar="NAME")
    parser.add_argument("--timeout", type=float, default=600, help="seconds for one peer and one S")
    parser.add_argument("--no-growth", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    RESULTS.mkdir(exist_ok=True)
    limits = machine(options.threads)
    load = os.getloadavg()
    print(f"matrix product {limits['gmadds']:.0f} G multiply-adds/s, copy {limits['gbytes']:.1f} GB/s; load {load[0]}")
    table = comparison(options)
    print(table.to_string(index=False, float_format=lambda value: f"{value:.3g}"))
    table.assign(**limits, load=os.getloadavg()[0]).to_parquet(RESULTS / "quantum.parquet")
    if not options.no_growth:
        grown = growth(options, limits)
        print(grown.to_string(index=False, float_format=lambda value: f"{value:.3g}"))
        grown.assign(**limits).to_parquet(RESULTS / "quantum_growth.parquet")


if __name__ == "__main__":
    main()
