"""CSV: `<out>/<run_id>/metrics.csv`, `eval.csv` and `summary.csv`, each replaced whole."""

from pathlib import Path
from typing import Any

import pandas as pd

from qnerf.export.content import Content
from qnerf.records.files import replace, reporting


def export(content: Content, out: Path) -> Path:
    """The folder written.

    metrics.csv: one row a step: step, time_s, wall_time (Unix seconds), then a column a key; `nan` is a value, an empty
    cell is none. eval.csv: one row a held-out image. summary.csv: one row: state, tags, note, results, configuration.
    """
    folder = out / content.run_id
    with reporting(folder):
        folder.mkdir(parents=True, exist_ok=True)
    _write(folder / "metrics.csv", wide(content.metrics, content.created))
    _write(folder / "eval.csv", content.evaluation)
    labels = {"tags": ",".join(content.annotations.tags), "note": content.annotations.note}
    row = {"run_id": content.run_id, **content.results, "state": content.state, **labels, **content.config}
    _write(folder / "summary.csv", pd.DataFrame([row]))
    return folder


def wide(metrics: pd.DataFrame, created: float) -> pd.DataFrame:
    """One row a step, one column a key, values as text in full precision."""
    rows = metrics.drop_duplicates(["step", "key"], keep="last")
    values = rows.assign(value=rows["value"].map(repr)).pivot(index="step", columns="key", values="value")
    time_s = rows.groupby("step")["time_s"].max()
    values.insert(0, "time_s", time_s)
    values.insert(1, "wall_time", created + time_s)
    return values.reset_index()


def _write(path: Path, frame: pd.DataFrame) -> None:
    safe = frame.map(harmless)
    replace(path, safe.to_csv(index=False).encode())


def harmless(value: Any) -> Any:
    """Text that a spreadsheet would take for a formula gets an apostrophe before it; numbers stay."""
    if not isinstance(value, str) or not value.startswith(("=", "+", "-", "@", "\t", "\r")):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value
