"""The same runs and rows in MLflow: `python -m benchmarks.peers.mlflow_runs write|search|log DATABASE ...`.

Nothing here imports qnerf, so that the file runs in any environment with MLflow. Measurements are printed as JSON.
"""

import argparse
import itertools
import json
import logging
import time
from pathlib import Path
from statistics import median
from typing import Any

import mlflow
from mlflow import MlflowClient
from mlflow.entities import Metric, Param

EXPERIMENT = "0"
MAX_PARAMS = 100  # in one request


def write(client: MlflowClient, file: Path, seconds: float) -> dict[str, Any]:
    """Logs the runs of a file of JSON lines until the time is up; runs that the database has already are skipped."""
    existing = len(mlflow.search_runs([EXPERIMENT], max_results=50_000, output_format="list"))
    written, start = 0, time.perf_counter()
    with open(file) as lines:
        for line in itertools.islice(lines, existing, None):
            if time.perf_counter() - start > seconds:
                break
            _write_one(client, json.loads(line))
            written += 1
    return {"version": mlflow.__version__, "written": written, "seconds": time.perf_counter() - start}


def _write_one(client: MlflowClient, run: dict[str, Any]) -> None:
    now = int(time.time() * 1000)
    run_id = client.create_run(EXPERIMENT, start_time=now, run_name=run["name"]).info.run_id
    params = [Param(key, str(value)[:500]) for key, value in run["params"].items()]
    metrics = [Metric(key, value, now, 0) for key, value in run["metrics"].items()]
    for first in range(0, len(params), MAX_PARAMS):
        client.log_batch(run_id, params=params[first : first + MAX_PARAMS])
    client.log_batch(run_id, metrics=metrics)
    client.set_terminated(run_id)


def search(repeats: int) -> dict[str, Any]:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        frame = mlflow.search_runs([EXPERIMENT], max_results=50_000)
        times.append(time.perf_counter() - start)
    return {"version": mlflow.__version__, "runs": len(frame), "columns": frame.shape[1], "first": times[0],
            "median": median(times)}  # fmt: skip


def log(client: MlflowClient, steps: int, keys: list[str]) -> dict[str, Any]:
    """Seconds for each step that logs one row of metrics, by log_metrics and by log_batch."""
    values = dict.fromkeys(keys, 0.5)
    with mlflow.start_run(experiment_id=EXPERIMENT) as run:
        fluent = []
        for step in range(steps):
            start = time.perf_counter()
            mlflow.log_metrics(values, step=step)
            fluent.append(time.perf_counter() - start)
        batch = []
        for step in range(steps, 2 * steps):
            start = time.perf_counter()
            client.log_batch(run.info.run_id, metrics=[Metric(key, value, 0, step) for key, value in values.items()])
            batch.append(time.perf_counter() - start)
    return {"version": mlflow.__version__, "log_metrics": median(fluent), "log_batch": median(batch)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["write", "search", "log"])
    parser.add_argument("database", type=Path, help="SQLite file")
    parser.add_argument("--runs", type=Path, help="write: file of JSON lines with name, params, metrics")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="write: stop after that time")
    parser.add_argument("--repeats", type=int, default=3, help="search: how often")
    parser.add_argument("--steps", type=int, default=50, help="log: how many")
    parser.add_argument("--keys", default="", help="log: names of the metrics of a row")
    options = parser.parse_args()
    for name in ("alembic", "mlflow"):
        logging.getLogger(name).setLevel(logging.WARNING)
    uri = f"sqlite:///{options.database.absolute()}"
    mlflow.set_tracking_uri(uri)
    client = MlflowClient(uri)
    if options.what == "write":
        result = write(client, options.runs, options.seconds)
    elif options.what == "search":
        result = search(options.repeats)
    else:
        result = log(client, options.steps, options.keys.split(","))
    print(json.dumps(result))


if __name__ == "__main__":
    main()
