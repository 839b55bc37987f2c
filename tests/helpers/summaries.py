"""The files of runs that the index reads."""

import json
from pathlib import Path
from typing import Any

from qnerf.records import files, schemas
from qnerf.records.parquet import encode

CONFIG = {"seed": 0, "train": {"lr": 0.01, "steps": 10}, "experiment": None}
TYPES = {"seed": "int", "train.lr": "float", "train.steps": "int"}
SUMMARY, STATUS, ANNOTATIONS = "summary.parquet", "status.json", "annotations.json"


def put(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    files.replace(path, data, durable=False)


def write(store: Path, name: str, state: str = "finished", config: dict | None = None, **results: Any) -> Path:
    """Writes the files of a run that the index reads, as the writer would."""
    results = {"run_id": name, "state": state} | results
    put(store / name / SUMMARY, encode(schemas.summary(results, CONFIG | (config or {}), TYPES)))
    status = {"state": state, "step": 10, "created": 100.0, "heartbeat": 110.0, "error": None}
    put(store / name / STATUS, json.dumps(status).encode())
    return store / name
