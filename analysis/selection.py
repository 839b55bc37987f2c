"""Which runs a table or figure uses, which are left out and why, and which must not be averaged together."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from qnerf.metrics import COLORLESS, metric_of, quality_metrics
from qnerf.records.filters import check_column
from qnerf.records.schemas import LABELS, RECORDED, is_option, is_own
from qnerf.search.objectives import TUNING

SCENES = ("scene_name", "scene.path", "scene", "scene.name")
"""Row keys that tell scenes apart."""

FIRST_KEYS = ("scene_name", "field", "density", "color")
"""Row keys that every table of the report has, where they act in a run."""

_PROGRESS = ("seed", "step", "created", "heartbeat")  # numbers that measure nothing
NAMED: set[str] = set()
"""Settings of runs of other programs, whose names may be anything (`foreign.read`)."""

QUANTUM = {"density": ("qdensity", "qboth"), "color": ("qcolor", "qboth"), "head": ("quantum",)}
"""Head -> the fields in which it is a circuit."""
CIRCUITS = frozenset(itertools.chain(*QUANTUM.values()))
"""Fields with a circuit; a tracked run has a field of its own name."""

_SCALARS = ("field", "experiment", "geo_features", "appearance")
_OF_TRACKED = ("field", *RECORDED)
"""Settings of tracked runs alone: in others the heads decide the field, and the options are only recorded."""


@dataclass(frozen=True)
class Selection:
    """The finished runs that have the metric, and how many were left out for which reason."""

    runs: pd.DataFrame
    left_out: Mapping[str, int]

    @property
    def note(self) -> str:
        """`left out: 2 interrupted, 1 NaN psnr; colourless: 1`; empty where nothing has to be said."""
        left = "left out: " + ", ".join(f"{count} {reason}" for reason, count in self.left_out.items())
        gone = int(colorless(self.runs).sum())
        parts = [
            left * bool(self.left_out),
            "all of a search: no test views" * bool(validating(self.runs).all()),
            f"colourless (explained variance below {COLORLESS:g}): {gone}" * bool(gone),
        ]
        return "; ".join(filter(None, parts))


def select(frame: pd.DataFrame, metric: str = "psnr", rows: Sequence[str] = ()) -> Selection:
    """The runs of `frame` (from `load.runs`) that finished with a finite `metric`.

    Runs that measured validation views are left out, unless there are no others.

    rows: keys by which they will be grouped, as `check_keys` and `refuse_mixtures` want them. ValueError also where no
    run finished so; the message counts the states and lists the metrics that runs have.
    """
    check_keys(frame, rows)
    states = frame["state"].fillna("unknown").value_counts()
    finished = frame[frame["state"] == "finished"]
    searched = validating(finished)
    if not searched.all():
        finished = finished[~searched]
    if finished.empty:
        raise ValueError(f"no finished runs among {len(frame)}: {states.to_dict()}")
    if metric not in finished.columns or not pd.api.types.is_numeric_dtype(finished[metric]):
        raise ValueError(f"no metric {metric!r}; the runs have {_known(finished)}")
    values = finished[metric].astype(float)
    usable = finished[np.isfinite(values)].copy()
    if usable.empty:
        reasons = finished.get(f"{metric}_reason", pd.Series(dtype=object)).dropna()
        why = f" ({reasons.iloc[0]})" if len(reasons) else ""
        raise ValueError(f"no finished run of {len(finished)} has {metric}{why}; have: {_known(finished)}")
    if rows:
        refuse_mixtures(usable, rows)
    left_out: dict[str, int] = {str(name): count for name, count in states.drop("finished").items()}
    if not searched.all():
        left_out["of a search"] = int(searched.sum())
    left_out |= {f"NaN {metric}": int(values.isna().sum()), f"infinite {metric}": int(np.isinf(values).sum())}
    return Selection(usable, {reason: count for reason, count in left_out.items() if count})


def colorless(runs: pd.DataFrame) -> pd.Series:
    """Which runs show one colour, or nothing: bool."""
    return runs["explained"] < COLORLESS if "explained" in runs else pd.Series(False, runs.index)


def validating(runs: pd.DataFrame) -> pd.Series:
    """Which runs measured validation views, or have a seed that judges nothing: bool."""
    held_out = runs["scene.validation"].notna() if "scene.validation" in runs else False
    return held_out | runs["seed"].isin(TUNING)


def by_scene(frame: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Scene -> its runs."""
    return dict(list(frame.groupby("scene_name")))


def configuration(frame: pd.DataFrame) -> list[str]:
    """Columns of the flat configuration, without the seed: the field, and every option."""
    options = [name for name in map(str, frame.columns) if is_option(name) or name in NAMED]
    return list(dict.fromkeys(name for name in (*_SCALARS, *options) if name in frame.columns))


def settings(runs: pd.DataFrame) -> pd.DataFrame:
    """The settings in which the results of runs may differ, as text; "" where one does not act in a run."""
    differing = [name for name in configuration(runs) if runs[name].nunique(dropna=False) > 1]
    texts = runs[differing].map(lambda value: "" if value is None or value != value else _part(value))
    tracked = runs.get("encoder", pd.Series("", runs.index)).isna()  # every run that qnerf trains has an encoder
    for name in texts.columns.intersection(_OF_TRACKED):
        texts[name] = texts[name].where(tracked, "")
    return texts.loc[:, texts.nunique() > 1]


def main_metric(runs: pd.DataFrame) -> str:
    """What verdicts are about unless a user says otherwise: PSNR, or the first quality that the runs have.

    Tracked runs without any have the first of their own results.
    """
    names = measured(runs)
    own = [name for name in names if is_own(name)]
    return next((name for name in (*(item.key for item in quality_metrics()), *own) if name in names), "psnr")


def measured(runs: pd.DataFrame) -> list[str]:
    """Columns with a number in at least one run that do not belong to the configuration."""
    known = set(configuration(runs))
    return [
        name
        for name in runs.select_dtypes("number").columns
        if name not in known and name not in _PROGRESS and runs[name].notna().any()
    ]


def _known(runs: pd.DataFrame, most: int = 8) -> str:
    """The first columns of `measured`, qualities before sizes and times."""
    names = sorted(measured(runs), key=lambda name: metric_of(name).kind in ("size", "time"))
    return ", ".join(names[:most]) + (", ..." if len(names) > most else "")


def row_keys(runs: pd.DataFrame) -> list[str]:
    """Scene, field, heads, and further settings that are needed so that no row mixes configurations."""
    keys = [key for key in FIRST_KEYS if runs[key].notna().any()]
    names = ("encoder", "hash", *LABELS, *settings(runs))
    for name in (name for name in names if runs[name].nunique(dropna=False) > 1):
        if name not in keys and runs.groupby(keys, dropna=False)[name].nunique(dropna=False).max() > 1:
            keys.append(name)
    return keys


def classical_baseline(runs: pd.DataFrame, rows: Sequence[str]) -> dict[str, object]:
    """The classical configuration as a baseline; of several the one on most scenes, then the one with most runs.

    Its steps may differ between scenes: `qnerf decide --equal time` trains a first run to measure a step, and then all
    runs with more steps. ValueError where there is none.
    """
    classical = runs[runs["field"] == "classical"] if "field" in rows else runs[:0]
    if classical.empty:
        key = next((key for key in rows if key not in SCENES), "color")
        raise ValueError(f"there is no classical field: give --baseline, such as {key}={label(runs[key].iloc[0])}")
    keys = [key for key in rows if key not in (*SCENES, "train.steps")]
    groups = classical.groupby(classical.groupby(keys, dropna=False).ngroup())
    sizes = pd.DataFrame({"scenes": groups["scene_name"].nunique(), "runs": groups.size()})
    own = groups.get_group(sizes.sort_values(["scenes", "runs"], ascending=False, kind="stable").index[0])
    found = {key: own[key].iloc[0] for key in keys if classical[key].nunique(dropna=False) > 1}
    if "train.steps" in rows:
        found["train.steps"] = list(
            own.groupby("scene_name")["train.steps"].agg(lambda steps: steps.mode().max()).unique()
        )
    return {"field": "classical"} | found


def check_keys(frame: pd.DataFrame, rows: Sequence[str]) -> None:
    """ValueError where a key is no column, with the nearest names."""
    for key in rows:
        if (known := check_column(key, frame.columns)) != key:
            raise ValueError(f"no run has a column {key!r}; did you mean {known}?")


def refuse_mixtures(runs: pd.DataFrame, rows: Sequence[str]) -> None:
    """ValueError where groups of `rows` compare different scenes, or one group mixes configurations."""
    refuse_scenes(runs, rows)
    groups = runs.groupby(list(rows), dropna=False, sort=False)
    names = [key for key in (*LABELS, *settings(runs)) if key in runs.columns and key not in rows]
    varying = [key for key in names if runs[key].nunique(dropna=False) > 1]
    if varying:
        several = groups[varying].nunique(dropna=False) > 1
        mixed = several[several.any(axis=1)]
        if len(mixed):
            keys = mixed.columns[mixed.iloc[0]]
            group = runs[groups.ngroup() == int(several.any(axis=1).to_numpy().argmax())]  # a key may be NaN
            different = ", ".join(f"{key} ({_values(group[key])})" for key in keys[:3])
            raise ValueError(
                f"row {label(mixed.index[0])} mixes runs of different {different}: add a key to the rows or filter"
            )


def refuse_scenes(runs: pd.DataFrame, rows: Sequence[str]) -> None:
    """ValueError where one group has runs of several scenes, or the row keys do not name the scene."""
    names = sorted(map(str, runs["scene_name"].unique()))
    keys = [key for key in rows if key in SCENES]
    together = not keys or (runs.groupby(keys, dropna=False)["scene_name"].nunique() > 1).any()
    if len(names) > 1 and together:
        raise ValueError(
            f"{len(names)} scenes in one table ({', '.join(names)}): add scene_name to the rows, or filter on one"
        )


def label(key: object) -> str:
    """A group's key as text: `fox_64, qcolor`. Whole floats are printed as integers."""
    return ", ".join(map(_part, _as_tuple(key)))


def _part(value: object) -> str:
    if value is None or value != value:
        return "none"
    return f"{value:.0f}" if isinstance(value, float) and value.is_integer() else str(value)


def _as_tuple(key: object) -> tuple[object, ...]:
    return key if isinstance(key, tuple) else (key,)


def _values(column: pd.Series, most: int = 4) -> str:
    values = [label(value) for value in column.unique()]
    return ", ".join(values[:most]) + (", ..." if len(values) > most else "")
