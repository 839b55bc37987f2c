"""Whether two runs gave the same numbers, and what differs in where they were computed."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from qnerf.config.identity import flatten
from qnerf.records import StoreError, read_config, read_metrics, read_summary
from qnerf.records.environment import differences
from qnerf.records.files import read_bytes, read_record
from qnerf.records.read import read_table
from qnerf.records.schemas import SUMMARY

CLOCKS = ("time/", "time.", "eval/eval_s", "eval_s", "train_s", "step_ms", "peak_memory_mb")
"""How long it took and how much memory: nobody's promise, left out of the comparison."""
MOST_DIFF_BYTES = 2**26


@dataclass(frozen=True)
class Compared:
    """One name's numbers in two runs."""

    table: str  # metrics | eval | summary
    name: str
    numbers: int  # in either run
    missing: int  # of them, in one run only
    largest: float  # relative difference |a - b| / max(|a|, |b|); 0: bit-equal
    first: str  # where they differ first: a step, an image; empty where they do not

    def agrees(self, tolerance: float) -> bool:
        return not self.missing and self.largest <= tolerance


def compare(before: Path, after: Path) -> list[Compared]:
    """Every logged metric, evaluated image and result of two runs, clocks left out."""
    return [
        *_compared("metrics", _metrics(before), _metrics(after)),
        *_compared("eval", _evaluation(before), _evaluation(after)),
        *_compared("summary", _summary(before), _summary(after)),
    ]


def environments(run: Path) -> list[dict[str, Any]]:
    """environment.json and, of a run that went on elsewhere, those after it; the diff's text is under `git.diff`."""
    found = []
    for number in range(1, 10_000):
        suffix = "" if number == 1 else f"-{number}"
        path, patch = run / f"environment{suffix}.json", run / f"dirty{suffix}.diff"
        if not path.exists():
            break
        environment = read_record(path)
        text = read_bytes(patch, MOST_DIFF_BYTES).decode(errors="replace") if patch.exists() else ""
        found.append(environment | {"git": {**environment.get("git", {}), "diff": text}})
    return found


def environment_differences(before: Path, after: Path) -> dict[str, tuple[str, str]]:
    """Name -> its values where the runs started, as short text."""
    one, other = environments(before), environments(after)
    if not one or not other:
        raise StoreError(f"{before if not one else after}: has no environment.json")
    return {name: (_short(a), _short(b)) for name, (a, b) in differences(one[0], other[0]).items()}


def recorded_threads(run: Path) -> int | None:
    """CPU threads that PyTorch used; None where that was not recorded."""
    threads = next((environment.get("threads") for environment in environments(run)), None)
    count = threads.get("torch") if isinstance(threads, dict) else None
    return count if isinstance(count, int) else None


def _metrics(run: Path) -> pd.DataFrame:
    rows = read_metrics(run)
    return pd.DataFrame({"name": rows["key"], "place": "step=" + rows["step"].astype(str), "value": rows["value"]})


def _evaluation(run: Path) -> pd.DataFrame:
    rows = read_table(run / "eval.parquet").to_pandas()
    numbers = rows.set_index("image").select_dtypes("number").drop(columns="step")
    return numbers.melt(ignore_index=False, var_name="name").rename_axis("place").reset_index()


def _summary(run: Path) -> pd.DataFrame:
    options = flatten(read_config(run))
    results = {k: v for k, v in read_summary(run).items() if k in SUMMARY or k not in options}
    numbers = {k: v for k, v in results.items() if isinstance(v, (int, float)) and not isinstance(v, bool)}
    return pd.DataFrame({"name": list(numbers), "place": "end", "value": [float(v) for v in numbers.values()]})


def _compared(table: str, before: pd.DataFrame, after: pd.DataFrame) -> Iterator[Compared]:
    both = before.merge(after, how="outer", on=["name", "place"], suffixes=("", "_after"), indicator=True, sort=False)
    both = both[~both["name"].str.startswith(CLOCKS)]
    for name, rows in both.groupby("name", sort=False):
        alone = (rows["_merge"] != "both").to_numpy()
        relative = np.where(alone, 0.0, relative_difference(rows["value"].to_numpy(), rows["value_after"].to_numpy()))
        unequal = alone | (relative > 0)
        first = str(rows["place"].iloc[int(unequal.argmax())]) if unequal.any() else ""
        yield Compared(table, str(name), len(rows), int(alone.sum()), float(relative.max()), first)


def relative_difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """|a - b| / max(|a|, |b|), elementwise; 0 where both are equal or both NaN, infinite where only one is finite."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        relative = np.abs(a - b) / np.maximum(np.abs(a), np.abs(b))
    relative = np.where(np.isfinite(relative), relative, np.inf)
    return np.where((a == b) | (np.isnan(a) & np.isnan(b)), 0.0, relative)


def _short(value: Any, most: int = 60) -> str:
    if isinstance(value, str) and "\n" in value:
        return f"{len(value.splitlines())} lines, {value.splitlines()[0][:most]} ..."
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= most else f"{text[:most]}..."
