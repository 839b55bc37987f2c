"""The runs as the page's script reads them, and the texts at the top of the page."""

from datetime import UTC, datetime
from itertools import chain
from typing import Any

import pandas as pd

from qnerf.metrics import HEAD_PARAMETERS, METRICS, metric_of, quality_metrics
from qnerf.records import filters

from .. import style
from ..figures import points
from ..load import with_needed
from ..selection import configuration, main_metric, row_keys
from . import curves, pictures
from .columns import packed

FIRST_COLUMNS = ("run_id", "state")
LABEL_COLUMNS = ("scene_name", "field", "encoder", "density", "color", "seed")
COST_COLUMNS = ("params.heads", "params.total", "step_ms", "train_s")
"""The table of runs shows these to begin with, and the image metrics before the costs."""

MOST_KEYS = 8  # that tell configurations apart, among the first columns

HEADINGS = {"run_id": "id"}  # others as they are typed
SYMBOLS = {"s": "square", "o": "circle", "^": "triangle-up", "D": "diamond"}
"""Matplotlib's markers -> Plotly's."""

_RUN = ("seed", "device", "threads")  # settings that tell no configurations apart


def prepared(frame: pd.DataFrame) -> pd.DataFrame:
    """`frame` with the columns that `described` and `named` add for the page."""
    return named(described(with_needed(frame.reset_index(drop=True))))


def described(frame: pd.DataFrame) -> pd.DataFrame:
    """`frame` with an id and the parameters of the heads."""
    new: dict[str, object] = {"run_id": frame["run_id"].fillna(frame["path"].str.rsplit("/", n=1).str[-1])}
    new["params.heads"] = frame[list(HEAD_PARAMETERS)].sum(axis=1, min_count=1)
    return frame.assign(**new)


def named(frame: pd.DataFrame) -> pd.DataFrame:
    """`frame` with `configuration`, a name from `points.points`; damaged runs have none."""
    named = frame.assign(configuration=None)
    readable = frame[frame["state"] != "damaged"]
    if len(readable):
        table = points.points(readable, [main_metric(frame)])
        names = {row: name for name, rows in zip(table["name"], table["runs"], strict=True) for row in rows}
        named["configuration"] = named.index.to_series().map(names).astype(object)
    return named


def order(frame: pd.DataFrame) -> list[int]:
    """Row numbers in the order in which runs get pictures and curves: one seed of every configuration first."""
    metric = main_metric(frame)
    ranked = frame.sort_values([metric, "run_id"], ascending=[metric_of(metric).sign < 0, True])
    group = ranked["configuration"].fillna(ranked["run_id"])
    number = ranked.groupby([ranked["scene_name"].fillna(""), group]).cumcount()
    later = ~ranked["state"].eq("finished")
    return ranked.assign(later=later, number=number).sort_values(["later", "number"], kind="stable").index.tolist()


def data(frame: pd.DataFrame, drawn: pictures.Pictures, logged: dict[int, Any]) -> dict[str, Any]:
    """The data of the page's script."""
    columns = packed(frame.drop(columns=["store", "scene"], errors="ignore"))
    settings = [name for name in columns if name in (*_RUN, *configuration(frame))]
    finished = frame.loc[frame["state"] == "finished", "scene_name"]
    quality = [metric.key for metric in quality_metrics()]
    metric = main_metric(frame)
    first, *others = FIRST_COLUMNS
    readable = frame[frame["state"] != "damaged"]
    differing = row_keys(readable)[:MOST_KEYS] if len(readable) else []
    shown = [name for name in quality if not metric_of(name).on_request]
    usual = list(dict.fromkeys((first, metric, *others, *LABEL_COLUMNS, *differing, *shown, *COST_COLUMNS)))
    return {
        "total": len(frame),
        "columns": columns,
        "settings": settings,
        "shown": [
            name
            for name in usual
            if name in columns and (name in (first, *others, *quality, metric) or "values" in columns[name])
        ],
        "usual": usual,
        "metrics": {name: _described(name) for name in {*METRICS, *HEADINGS, *columns}},
        "quality": list(dict.fromkeys([*quality, metric])),
        "metric": metric,
        "aliases": filters.ALIASES,
        "scenes": finished.value_counts().index.tolist(),
        "fields": {name: {"colour": color, "symbol": SYMBOLS[mark]} for name, (color, mark) in style.FIELDS.items()},
        "palette": style.PALETTE,
        "curves": logged,
        "curve_names": {key: metric_of(key).heading for key in curves.arranged(chain(*logged.values()))},
        "pictures": {"files": drawn.files, "runs": drawn.runs, "none": not drawn.files},
    }


def dates(frame: pd.DataFrame) -> str:
    """`started 2026-01-03 to 2026-01-05`, in UTC; empty where no run says when."""
    if "created" not in frame or frame["created"].isna().all():
        return ""
    first, last = (
        datetime.fromtimestamp(float(t), UTC).date().isoformat() for t in frame["created"].agg(["min", "max"])
    )
    return f"started {first}" if first == last else f"started {first} to {last}"


def no_pictures(drawn: pictures.Pictures) -> str:
    """Why there are no pictures; empty where there are some."""
    absent = "No pictures: packed runs and those of other programs have none, and --max-images 0 leaves them out."
    return "" if drawn.files else f"{absent} {drawn.note}".strip()


def no_curves(logged: dict[int, Any]) -> str:
    """Why there are no curves; empty where there are some."""
    return "" if logged else "No run has logged a value: they come every train.log_every steps."


def _described(name: str) -> dict[str, Any]:
    """A column as the page's script reads it; `digits` is null where nothing is to be rounded."""
    metric = metric_of(name)
    heading = HEADINGS.get(name, metric.heading)
    return {"heading": heading, "digits": metric.digits}
