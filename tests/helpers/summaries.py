"""The files of runs that the index reads."""

import json
import shutil
from pathlib import Path
from typing import Any

import pandas as pd

from qnerf.records import files, index, schemas, summary_row
from qnerf.records.index.locations import STATUS, SUMMARY

CONFIG = {"seed": 0, "train": {"lr": 0.01, "steps": 10}, "experiment": None}


def put(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    files.replace(path, data, durable=False)


def write(store: Path, name: str, state: str = "finished", config: dict | None = None, **results: Any) -> Path:
    """Writes the files of a run that the index reads, as the writer would."""
    results = {"run_id": name, "state": state} | results
    put(store / name / SUMMARY, summary_row.encode(schemas.summary(results, CONFIG | (config or {}))))
    status = {"state": state, "step": 10, "created": 100.0, "heartbeat": 110.0, "error": None}
    put(store / name / STATUS, json.dumps(status).encode())
    return store / name


def load_without_index(store: Path) -> pd.DataFrame:
    """The table of a copy of the store, without its index."""
    copy = store.parent / "copy" / store.name
    shutil.rmtree(copy.parent, ignore_errors=True)
    shutil.copytree(store, copy, ignore=shutil.ignore_patterns(".index"), symlinks=True)
    frame = index.load(copy)
    frame["path"] = frame["path"].str.replace(str(copy), str(store), regex=False)
    return frame
