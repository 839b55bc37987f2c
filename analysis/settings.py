"""A run's settings other than its seed: which columns they are, and which have an effect in it.

The width of an MLP has no effect where the head is a circuit, nor do a circuit's options where it is an MLP. A sweep
over circuits therefore trains the same classical field several times; such runs must count once.
"""

from collections.abc import Collection

import numpy as np
import pandas as pd

LABELS = ("field", "encoder", "qiren", "hash", "density", "color", "head", "sampler", "cameras", "train")
QUANTUM = {"density": ("qdensity", "qboth"), "color": ("qcolor", "qboth"), "head": ("quantum",)}
"""Head -> the fields in which it is a circuit."""

_SCALARS = ("experiment", "geo_features", "appearance")
_RESULTS = ("params", "time", "run", "needs")  # first parts of dotted names that are no configuration
# These act only through density.*, color.*, encoder.* and sampler.*, which copy them.
_SOURCES = (
    "qiren.",
    "hash.",
    "proposal.",
    "density.initials.",
    "density.rates.",
    "color.rates.",
    "color.activations.",
)
# Logging, checks and the scene's location do not change a result.
_IRRELEVANT = (
    "scene.path",
    "numerics.finite_checks",
    "train.log_every",
    "train.eval_every",
    "train.eval_views",
    "train.checkpoint_every",
    "train.chunk",
)


def configuration(frame: pd.DataFrame) -> list[str]:
    """Columns of the flat configuration that influence a result, without the seed."""
    dotted = [name for name in frame.columns if "." in name and name.split(".")[0] not in _RESULTS]
    return [name for name in (*_SCALARS, *dotted) if name in frame.columns and name not in _IRRELEVANT]


def without_constants(frame: pd.DataFrame, keep: Collection[str] = ()) -> pd.DataFrame:
    """The table without settings that are the same in all its runs: they tell no two runs apart, and there are many.

    keep: settings that stay in any case.
    """
    settings = [name for name in configuration(frame) if name not in (*keep, "color.directions")]
    return frame.drop(columns=[name for name in settings if frame[name].nunique(dropna=False) < 2])


def effective(runs: pd.DataFrame) -> pd.DataFrame:
    """The settings that influence each run's result, as text; "" where one has no effect in that run."""
    keys = [key for key in configuration(runs) if not key.startswith(_SOURCES)]
    idle: dict[str, np.ndarray] = {}
    for head, circuits in QUANTUM.items():
        quantum = runs["field"].isin(circuits).to_numpy()
        idle |= {f"{head}.qiren.": ~quantum, f"{head}.mlp.": quantum}
    if "color.directions" in runs:
        idle["color.direction_scale"] = runs["color.directions"].ne("raw").to_numpy()
    columns = {}
    for key in keys:
        text = np.array(_texts(runs[key]), dtype=object)
        for start, without_effect in idle.items():
            if key.startswith(start):
                text[without_effect] = ""
        columns[key] = text
    return pd.DataFrame(columns, index=runs.index)


def _texts(column: pd.Series) -> list[str]:
    """str of each value, "" where it is absent; equal values of one type are written once, which is much faster."""
    known: dict[tuple[type, object], str] = {}
    values = [None if value != value else value for value in column.tolist()]
    return ["" if v is None else known.get((type(v), v)) or known.setdefault((type(v), v), str(v)) for v in values]


def first_of_each(frame: pd.DataFrame) -> pd.Series:
    """For a run that repeats another: the `run_id` of the first finished run with its settings; else None."""
    finished = frame[frame["state"] == "finished"]
    if finished.empty:
        return pd.Series(None, index=frame.index, dtype=object)
    keys = _keys(*_acting(finished))
    firsts = finished["run_id"].groupby([keys[name] for name in keys], dropna=False).transform("first")
    return firsts.where(firsts != finished["run_id"]).reindex(frame.index).astype(object)


def distinct(runs: pd.DataFrame) -> pd.DataFrame:
    """`acting`, without runs that repeat an earlier one."""
    table, settings = _acting(runs)
    return table[~_keys(table, settings).duplicated()]


def acting(runs: pd.DataFrame) -> pd.DataFrame:
    """The runs with None for settings, and their labels, that have no effect in them."""
    return _acting(runs)[0]


def _keys(acting_runs: pd.DataFrame, settings: pd.DataFrame) -> pd.DataFrame:
    """Scene, seed and all effective settings: runs that agree in them computed the same."""
    return pd.concat([acting_runs.filter(["scene_name", "seed", *LABELS]), settings.add_prefix("setting ")], axis=1)


def _acting(runs: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """`acting` and `effective` of the runs."""
    settings = effective(runs)
    idle = settings == ""
    masks = {str(name): idle[name] for name in idle.columns[idle.any()]}
    groups = {}
    if "field" in runs:
        groups["qiren"] = runs["field"].eq("classical")
    if "encoder" in runs:
        groups["hash"] = runs["encoder"].ne("hash")
    masks |= {name: groups[start] for name in map(str, runs) if (start := name.partition(".")[0]) in groups}
    masked = {name: runs[name].astype(object).mask(mask, None) for name, mask in masks.items() if mask.any()}
    table = runs.assign(**masked)
    return table.copy(), settings  # in one block; pandas warns of frames whose columns were set one by one
