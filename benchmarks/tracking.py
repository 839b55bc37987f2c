"""Times of listing ten thousand runs and of logging a step: `python -m benchmarks.tracking STORE`.

First STORE is filled with `--runs` runs by the real writer (`benchmarks.many_runs`). With `--mlflow-python`, the same
runs are written into MLflow (SQLite) through its client and searched there. Prints a table of medians and saves it as
benchmarks/results/tracking.parquet.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from typing import Any

import pandas as pd
from qnerf.analysis import load

from benchmarks.logging_cost import KEYS, LOGGERS, flat_out, paced
from benchmarks.many_runs import compositions, generate, write_some
from benchmarks.tracking_mlflow import mlflow, write_lines
from qnerf.records import index

RESULTS = Path(__file__).parent / "results"
STEP = 0.02  # seconds of a classical training step on two cores
SCREEN = 40  # lines of a terminal
FIRST_SCREEN = ["run_id", "state", "field", "encoder", "qiren", "psnr", "step", "train_s", "created", "tags", "path"]

Measured = dict[str, Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store", help="folder of the runs; made where it is not there")
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes that fill the store")
    parser.add_argument("--repeats", type=int, default=5, help="the median counts")
    parser.add_argument("--seconds", type=float, default=20.0, help="of the training whose logging is measured")
    parser.add_argument("--mlflow-python", metavar="PYTHON", help="interpreter of an environment that has MLflow")
    parser.add_argument("--mlflow-database", type=Path, help="SQLite file to go on with (default: beside the store)")
    parser.add_argument("--mlflow-seconds", type=float, default=1200, help="write runs into MLflow for so long at most")
    options = parser.parse_args()
    rows = [*writing(options), *listing(options), *logging(options)]
    if options.mlflow_python:
        rows += in_mlflow(options)
    table = pd.DataFrame(rows).astype({"runs": "Int64"}).assign(load=os.getloadavg()[0], cores=os.cpu_count())
    RESULTS.mkdir(exist_ok=True)
    table.to_parquet(RESULTS / "tracking.parquet", index=False)
    print(
        table[["tool", "what", "value", "unit", "runs"]].to_string(
            index=False, float_format=lambda value: f"{value:.3g}"
        )
    )
    print(*verdicts(table), sep="\n")


def writing(options: argparse.Namespace) -> Iterator[Measured]:
    """Fills the store, then measures a hundred runs in another one."""
    generate(options.store, options.runs, options.jobs)
    with tempfile.TemporaryDirectory(dir=Path(options.store).parent) as folder:
        seconds = write_some(folder, 100, compositions(folder))
    yield measured("qnerf", "write a run", 1e3 * seconds / 100, "ms", 100)


def listing(options: argparse.Namespace) -> Iterator[Measured]:
    """The table of all runs without an index, with one, and as the command prints it."""
    index_folder = Path(options.store) / ".index"

    def cold() -> int:
        shutil.rmtree(index_folder, ignore_errors=True)
        return len(load.runs(options.store))

    runs = cold()
    tasks: dict[str, Callable[[], Any]] = {
        "load.runs, cold": cold,
        "load.runs, warm": lambda: load.runs(options.store),
        "columns of a screen, warm": lambda: index.load(options.store, FIRST_SCREEN),
        "qnerf runs, first screen": lambda: first_screen(options.store),
    }
    for name, task in tasks.items():
        yield measured("qnerf", name, median(timed(task, options.repeats)), "s", runs)


def first_screen(store: str) -> None:
    """The whole command, including the start of Python."""
    command = [sys.executable, "-c", "from qnerf.cli.main import main; main()", "runs", "--store", store]
    command += ["--limit", str(SCREEN)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert len(done.stdout.splitlines()) >= SCREEN, done.stdout


def logging(options: argparse.Namespace) -> Iterator[Measured]:
    """One row of ten metrics a step."""
    for name in LOGGERS:
        parts = [paced(name, round(options.seconds / STEP), STEP) for _ in range(3)]
        yield measured(name, "log a row of 10", median(part["us_per_call"] for part in parts), "us")
        yield measured(name, "share of a 20 ms step", 100 * median(part["share"] for part in parts), "%")
        rate = median(flat_out(name, 20_000) for _ in range(3))
        yield measured(name, "values a second", rate, "1/s")


def in_mlflow(options: argparse.Namespace) -> Iterator[Measured]:
    """The same in MLflow. Its calls wait for the database, so their whole time counts as share of a step."""
    database = options.mlflow_database or Path(options.store).with_suffix(".mlflow.db")
    python = options.mlflow_python
    with tempfile.TemporaryDirectory() as folder:
        lines = Path(folder) / "runs.jsonl"
        write_lines(options.store, lines)
        seconds = str(options.mlflow_seconds)
        written = mlflow(python, "write", database, "--runs", str(lines), "--seconds", seconds)
        seconds_per_call = mlflow(python, "log", Path(folder) / "log.db", "--keys", ",".join(KEYS))
    if written["written"]:
        yield measured("MLflow", "write a run", 1e3 * written["seconds"] / written["written"], "ms", written["written"])
    for what in ("log_metrics", "log_batch"):
        yield measured("MLflow", f"log a row of 10, {what}", 1e6 * seconds_per_call[what], "us")
    yield measured("MLflow", "share of a 20 ms step", 100 * seconds_per_call["log_batch"] / STEP, "%")
    yield measured("MLflow", "values a second", len(KEYS) / seconds_per_call["log_batch"], "1/s")
    searched = mlflow(python, "search", database, "--repeats", str(options.repeats))
    yield measured("MLflow", "search_runs", searched["median"], "s", searched["runs"])


def verdicts(table: pd.DataFrame) -> Iterator[str]:
    """Ratios between the measurements of this call."""
    warm = one(table, "qnerf", "load.runs, warm")
    for search in table[table["what"] == "search_runs"].itertuples():
        ratio = (search.value / search.runs) / (warm["value"] / warm["runs"])
        yield f"search_runs of {search.runs:,} runs takes {ratio:.0f} times as long a run as load.runs, warm"
    for tool in table[table["what"] == "values a second"]["tool"]:
        ratio = one(table, "qnerf", "values a second")["value"] / one(table, tool, "values a second")["value"]
        if tool != "qnerf":
            yield f"qnerf logs {ratio:.0f} times as many values a second as {tool}"


def one(table: pd.DataFrame, tool: str, what: str) -> pd.Series:
    (row,) = (row for _, row in table[(table["tool"] == tool) & (table["what"] == what)].iterrows())
    return row


def measured(tool: str, what: str, value: float, unit: str, runs: int | None = None) -> Measured:
    return {"tool": tool, "what": what, "value": value, "unit": unit, "runs": runs}


def timed(task: Callable[[], Any], repeats: int) -> list[float]:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        task()
        times.append(time.perf_counter() - start)
    return times


if __name__ == "__main__":
    main()
