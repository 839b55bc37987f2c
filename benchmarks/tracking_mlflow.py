"""Copies the runs of a store into MLflow, which has its own Python environment."""

import json
import math
import subprocess
from pathlib import Path
from typing import Any

import pandas as pd

from qnerf.config.identity import flatten
from qnerf.records import index, read_config

ROOT = Path(__file__).parents[1]


def write_lines(store: str, file: Path) -> int:
    """Writes one line {"name", "params", "metrics"} per run, the oldest first; returns how many."""
    frame = index.load(store).sort_values("created")
    options = config_columns(frame)
    with open(file, "w") as lines:
        for row in frame.to_dict("records"):
            values = {key: value for key, value in row.items() if _is_there(value)}
            params = {key: value for key, value in values.items() if key in options}
            results = values.keys() - options - {"created", "heartbeat"}
            metrics = {key: float(values[key]) for key in sorted(results) if _is_number(values[key])}
            lines.write(json.dumps({"name": row["run_id"], "params": params, "metrics": metrics}) + "\n")
    return len(frame)


def config_columns(frame: pd.DataFrame) -> set[str]:
    """Columns that are options, taken from one run of every field and encoder."""
    paths = frame.drop_duplicates(["field", "encoder"])["path"]
    return {key for path in paths for key in flatten(read_config(path))} - {"field", "encoder"}


def mlflow(python: str, what: str, database: Path, *arguments: str) -> dict[str, Any]:
    """The results of `benchmarks.peers.mlflow_runs`. ValueError with the end of MLflow's message if it failed."""
    command = [python, "-m", "benchmarks.peers.mlflow_runs", what, str(database), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    if done.returncode:
        raise ValueError(f"{what} in MLflow: {' '.join(done.stderr.split()[-40:])}")
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return result


def _is_there(value: Any) -> bool:
    return value is not None and value != () and not (isinstance(value, float) and math.isnan(value))


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
