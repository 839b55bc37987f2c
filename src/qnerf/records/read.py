"""Reading runs, live or finished, without any right to write."""

import json
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import yaml  # type: ignore[import-untyped]

from qnerf.records import owner
from qnerf.records.files import StoreError, reporting

STATES = ("running", "finished", "interrupted", "failed")


def runs(root: str | Path) -> list[Path]:
    """Folders of the runs in a store, sorted by name; empty when there is no store yet."""
    root = Path(root)
    with reporting(root, "read"):
        return (
            sorted(path for path in root.iterdir() if not path.name.startswith(".") and path.is_dir())
            if (root.is_dir())
            else []
        )


def read_status(run_dir: str | Path) -> dict[str, Any]:
    """status.json; empty when it is absent or damaged."""
    try:
        status = json.loads((Path(run_dir) / "status.json").read_text())
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return {}
    except OSError as error:
        raise StoreError(f"{run_dir}: cannot read status.json: {error.strerror or error}") from error
    return status if isinstance(status, dict) else {}


def state(run_dir: str | Path, status: dict[str, Any] | None = None) -> str:
    """running | finished | interrupted | failed. Derived: a run is running only while its owner is alive.

    `status` saves reading status.json again.
    """
    directory = Path(run_dir)
    status = read_status(directory) if status is None else status
    stored = status.get("state")
    if stored != "running":
        return stored if stored in STATES else "interrupted"
    beat = status.get("heartbeat")
    if not owner.alive(status, float(beat) if isinstance(beat, (int, float)) else None):
        return "interrupted"
    try:
        _, record = owner.newest(directory)
    except OSError:
        return "interrupted"
    return "interrupted" if record is None or record.get("released") else "running"


def read_config(run_dir: str | Path) -> dict[str, Any]:
    """The resolved configuration; nothing in the file is executed."""
    path = Path(run_dir) / "config.yaml"
    with reporting(path, "read"):
        text = path.read_text(encoding="utf-8")
    try:
        config = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise StoreError(f"{path}: not readable as YAML: {' '.join(str(error).split())}") from error
    if not isinstance(config, dict):
        raise StoreError(f"{path}: expected keys and values, got {type(config).__name__}")
    return config


def read_summary(run_dir: str | Path) -> dict[str, Any]:
    """summary.parquet as plain values. `state` is the one last written; `state(run_dir)` tells the true one."""
    path = Path(run_dir) / "summary.parquet"
    row: dict[str, Any] = read_table(path).to_pylist()[0]
    return row


def read_metrics(run_dir: str | Path) -> pd.DataFrame:
    """Columns step, time_s, key, value, in the order of logging."""
    folder = Path(run_dir) / "metrics"
    with reporting(folder, "read"):
        return pd.read_parquet(folder)


def read_table(path: Path) -> pa.Table:
    """A Parquet file in memory; StoreError when it is absent or damaged."""
    with reporting(path, "read"):
        data = path.read_bytes()
    try:
        # Not pq.read_table: its threads may still hold Python's buffer when the interpreter ends, which aborts.
        return pq.ParquetFile(pa.BufferReader(data)).read(use_threads=False)
    except (pa.ArrowException, OSError) as error:
        raise StoreError(f"{path}: damaged: {' '.join(str(error).split())}") from error
