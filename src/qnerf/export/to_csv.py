"""CSV: `<out>/<run_id>/metrics.csv`, `eval.csv` and `summary.csv`, each replaced whole."""

from pathlib import Path
from typing import Any

import pandas as pd

from qnerf.export.content import Content
from qnerf.records.files import replace, reporting


def export(content: Content, out: Path) -> Path:
    """Returns the folder.

    metrics.csv: one row per step: step, time_s, wall_time (Unix seconds), then one column per key. `nan` is a logged
    value; an empty cell means that nothing was logged. eval.csv: one row per held-out image. summary.csv: one row with
    state, tags, note, results and configuration.
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
    """One row per step, one column per key, values as text in full precision."""
    rows = metrics.drop_duplicates(["step", "key"], keep="last")
    values = rows.assign(value=rows["value"].map(repr)).pivot(index="step", columns="key", values="value")
    time_s = rows.groupby("step")["time_s"].max()
    values.insert(0, "time_s", time_s)
    values.insert(1, "wall_time", created + time_s)
    return values.reset_index()


def _write(path: Path, frame: pd.DataFrame) -> None:
    replace(path, frame.map(without_formula).to_csv(index=False).encode())


def without_formula(value: Any) -> Any:
    """Puts an apostrophe before text that a spreadsheet would run as a formula; numbers stay.

    >>> without_formula("=1+1"), without_formula("-1e3"), without_formula(-3)
    ("'=1+1", '-1e3', -3)
    """
    if not isinstance(value, str) or not value.startswith(("=", "+", "-", "@", "\t", "\r")):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value
