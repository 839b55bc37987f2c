"""CSV: `<out>/<run_id>/metrics.csv`, `eval.csv` and `summary.csv`, each replaced whole."""

from pathlib import Path

import pandas as pd

from qnerf.export.content import Content, make_folder
from qnerf.records.files import replace


def export(content: Content, out: Path) -> Path:
    """Returns the folder.

    metrics.csv: one row per step: step, time_s, wall_time (Unix seconds), then one column per key. `nan` is a logged
    value; an empty cell means that nothing was logged. eval.csv: one row per held-out image. summary.csv: one row with
    state, tags, note, results and configuration.
    """
    run = content.run
    folder = make_folder(out, run.path)
    labels = {"state": run.state, "tags": ",".join(run.annotations.tags), "note": run.annotations.note}
    summary = pd.DataFrame([{"run_id": run.run_id, **content.results, **labels, **run.flat}])
    for name, frame in {
        "metrics": wide(content.metrics, content.created), "eval": run.evaluation, "summary": summary,
    }.items():  # fmt: skip
        replace(
            folder / f"{name}.csv", frame.to_csv(index=False, lineterminator="\n").encode(errors="backslashreplace")
        )
    return folder


def wide(metrics: pd.DataFrame, created: float) -> pd.DataFrame:
    """One row per step, one column per key, values as text in full precision."""
    rows = metrics.drop_duplicates(["step", "key"], keep="last")
    values = rows.assign(value=rows["value"].map(repr)).pivot(index="step", columns="key", values="value")
    time_s = rows.groupby("step")["time_s"].max()
    times = pd.DataFrame({"step": time_s.index, "time_s": time_s, "wall_time": created + time_s})
    return pd.concat([times, values], axis=1)  # a key may have the name of one of the first columns
