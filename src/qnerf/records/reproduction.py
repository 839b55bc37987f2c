"""Compares the numbers of two runs."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from qnerf.config.checks import is_number
from qnerf.records.read import read_config, read_evaluation, read_metrics, read_summary
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


def compare(before: Path, after: Path) -> Iterator[Compared]:
    """Every logged metric, evaluated image and result of two runs, except `CLOCKS`."""
    keys = ["table", "name", "position"]
    both = _numbers(before).merge(_numbers(after), "outer", keys, suffixes=("", "_after"), indicator=True)
    for (table, name), rows in both[~both["name"].str.startswith(CLOCKS)].groupby(keys[:2]):
        missing = (rows["_merge"] != "both").to_numpy()
        relative = np.where(missing, 0.0, relative_difference(rows["value"].to_numpy(), rows["value_after"].to_numpy()))
        different = rows["position"].to_numpy()[missing | (relative > 0)]
        first = str(different[0]) if len(different) else ""
        yield Compared(str(table), str(name), len(rows), int(missing.sum()), float(relative.max()), first)


def _numbers(run: Path) -> pd.DataFrame:
    """Columns table, name, position (a step or an image) and value."""
    logged = read_metrics(run)
    logged = logged.assign(name=logged["key"], position="step=" + logged["step"].astype(str))
    images = read_evaluation(run).set_index("image").select_dtypes("number").drop(columns="step")
    measured = images.melt(ignore_index=False, var_name="name").rename_axis("position").reset_index()
    final = {name: value for name, value in results(read_summary(run), read_config(run)).items() if is_number(value)}
    ends = pd.DataFrame({"name": list(final), "value": list(final.values()), "position": "end"})
    tables = {"metrics": logged[["name", "position", "value"]], "eval": measured, "summary": ends}
    return pd.concat([rows.assign(table=table) for table, rows in tables.items()])


def relative_difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """|a - b| / max(|a|, |b|), elementwise; 0 where both are equal or both NaN, infinite where only one is finite."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        relative = np.abs(a - b) / np.maximum(np.abs(a), np.abs(b))
    relative = np.where(np.isfinite(relative), relative, np.inf)
    return np.where((a == b) | (np.isnan(a) & np.isnan(b)), 0.0, relative)
