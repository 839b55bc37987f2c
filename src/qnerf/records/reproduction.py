"""Compares two runs: their numbers, and the environments in which they were computed."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from qnerf.config.checks import is_number
from qnerf.records import StoreError, read_config, read_metrics, read_summary
from qnerf.records.environment import MAX_FILE_BYTES, differences, environment_files
from qnerf.records.files import read_bytes, read_json
from qnerf.records.read import read_evaluation
from qnerf.records.schemas import results

CLOCKS = ("time/", "time.", "eval/eval_s", "eval_s", "train_s", "step_ms", "step_cpu_ms", "peak_memory_mb")
"""Beginnings of the names of times and memory, which two equal runs need not share. They are not compared."""


@dataclass(frozen=True)
class Compared:
    """All numbers of one name in two runs.

    table: metrics, eval or summary. numbers: how many there are in either run. missing: how many are in one run only.
    largest: the largest relative difference |a - b| / max(|a|, |b|); 0 means bit-equal. first: the step or image of
    the first difference, or empty.
    """

    table: str
    name: str
    numbers: int
    missing: int
    largest: float
    first: str

    def agrees(self, tolerance: float) -> bool:
        return not self.missing and self.largest <= tolerance


def compare(before: Path, after: Path) -> list[Compared]:
    """Every logged metric, evaluated image and result of two runs, except `CLOCKS`."""
    return [
        *_compare_tables("metrics", _metrics(before), _metrics(after)),
        *_compare_tables("eval", _evaluation(before), _evaluation(after)),
        *_compare_tables("summary", _summary(before), _summary(after)),
    ]


def environments(run: Path) -> list[dict[str, Any]]:
    """The environments in which the run started and was resumed; the text of each diff is under `git.diff`."""
    result = []
    for path, patch in environment_files(run):
        if not path.exists():
            break
        environment = read_json(path)
        text = read_bytes(patch, MAX_FILE_BYTES).decode(errors="replace") if patch.exists() else ""
        git = environment.get("git")
        result.append(environment | {"git": {**(git if isinstance(git, dict) else {}), "diff": text}})
    return result


def environment_differences(before: Path, after: Path) -> dict[str, tuple[str, str]]:
    """Name -> its two values as short text, where the environments of the runs' starts differ."""
    first, second = environments(before), environments(after)
    if not first or not second:
        raise StoreError(f"{before if not first else after}: has no environment.json")
    return {name: (_shortened(a), _shortened(b)) for name, (a, b) in differences(first[0], second[0]).items() if a or b}


def recorded_threads(run: Path) -> int | None:
    """CPU threads that PyTorch used; None if that was not recorded."""
    threads = next((environment.get("threads") for environment in environments(run)), None)
    count = threads.get("torch") if isinstance(threads, dict) else None
    return count if isinstance(count, int) else None


def _metrics(run: Path) -> pd.DataFrame:
    rows = read_metrics(run)
    return pd.DataFrame({"name": rows["key"], "position": "step=" + rows["step"].astype(str), "value": rows["value"]})


def _evaluation(run: Path) -> pd.DataFrame:
    rows = read_evaluation(run)
    numbers = rows.set_index("image").select_dtypes("number").drop(columns="step")
    return numbers.melt(ignore_index=False, var_name="name").rename_axis("position").reset_index()


def _summary(run: Path) -> pd.DataFrame:
    summary = results(read_summary(run), read_config(run))
    numbers = {k: float(v) for k, v in summary.items() if is_number(v)}
    return pd.DataFrame({"name": list(numbers), "position": "end", "value": list(numbers.values())})


def _compare_tables(table: str, before: pd.DataFrame, after: pd.DataFrame) -> Iterator[Compared]:
    keys = ["name", "position"]
    both = before.merge(after, how="outer", on=keys, suffixes=("", "_after"), indicator=True, sort=False)
    both = both[~both["name"].str.startswith(CLOCKS)]
    for name, rows in both.groupby("name", sort=False):
        missing = (rows["_merge"] != "both").to_numpy()
        relative = np.where(missing, 0.0, relative_difference(rows["value"].to_numpy(), rows["value_after"].to_numpy()))
        differs = missing | (relative > 0)
        first = str(rows["position"].iloc[int(differs.argmax())]) if differs.any() else ""
        yield Compared(table, str(name), len(rows), int(missing.sum()), float(relative.max()), first)


def relative_difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """|a - b| / max(|a|, |b|), elementwise; 0 where both are equal or both NaN, infinite where only one is finite."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        relative = np.abs(a - b) / np.maximum(np.abs(a), np.abs(b))
    relative = np.where(np.isfinite(relative), relative, np.inf)
    return np.where((a == b) | (np.isnan(a) & np.isnan(b)), 0.0, relative)


def _shortened(value: Any, limit: int = 60) -> str:
    if isinstance(value, str) and "\n" in value:
        return f"{len(value.splitlines())} lines, {value.splitlines()[0][:limit]} ..."
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= limit else f"{text[:limit]}..."
