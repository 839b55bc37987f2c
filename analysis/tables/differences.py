"""The difference of each row of a table from a baseline row, with its interval."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, fields
from math import isinf
from typing import Any

import pandas as pd

from qnerf.records import filters

from .. import statistics
from ..selection import SCENES, label
from ..statistics import Difference

_COLUMNS = [field.name for field in fields(Difference)]


def against(
    runs: pd.DataFrame, rows: Sequence[str], keys: pd.DataFrame, baseline: str | Mapping[str, object], metric: str
) -> tuple[pd.DataFrame, list[str]]:
    """`Difference` of each group of `rows`, in `groupby`'s order, from the baseline of its scene; notes for under it.

    keys: one row a group, its key. The baseline's own row is NaN; where nothing pairs, seeds and views are 0. Two more
    columns: `p_holm`, the p-values after `statistics.holm`, and `star`, see `statistics.stars`.
    """
    reference = references(keys, rows, baseline)
    unmatched = keys[[base is None for base in reference]]
    group = dict(zip(runs["path"], runs.groupby(list(rows), dropna=False).ngroup(), strict=True))
    views = statistics.evaluations(runs, metric)
    parts = dict(list(views.groupby(views["path"].map(group))))
    empty = views.iloc[:0]
    lines = [
        [float("nan")] * len(_COLUMNS) if number == base else _line(parts.get(base, empty), parts.get(number, empty))
        for number, base in enumerate(reference)
    ]
    table = pd.DataFrame(lines, columns=_COLUMNS)
    table["p_holm"] = statistics.holm(table["p"].tolist())
    table["star"] = statistics.stars(table["p"].tolist(), table["seeds"].tolist())
    name = ", ".join(",".join(condition.values) for condition in filters.parse(baseline))
    notes = [f"difference from {name}: {statistics.method()}"]
    if len(unmatched):
        scenes = dict.fromkeys(label(tuple(scene)) for scene in unmatched[_scene_keys(rows)].to_numpy())
        notes.append(f"no baseline in {', '.join(scenes)}")
    if (table["seeds"] == 1).any():
        notes.append("pairs of one seed: the interval speaks about views alone")
    without = len(runs) - views["path"].nunique()
    if without:
        notes.append(f"{without} runs have no readable {metric} in eval.parquet and take no part in the differences")
    return table, notes


def references(keys: pd.DataFrame, rows: Sequence[str], baseline: str | Mapping[str, object]) -> list[int | None]:
    """For each row of `keys` the number of its scene's baseline row; None where the scene has none.

    ValueError where no scene has one, or a scene has several.
    """
    outside = [condition.key for condition in filters.parse(baseline) if condition.key not in rows]
    if outside:
        raise ValueError(f"baseline: {outside[0]!r} is not a row key; the rows are {', '.join(rows)}")
    matches = set(filters.require(keys, baseline, "rows").index)
    scenes = _scene_keys(rows)
    found: dict[Any, int | None] = {}
    for scene, members in keys.groupby(scenes, dropna=False) if scenes else [("the table", keys)]:
        ours = [number for number in members.index if number in matches]
        if len(ours) > 1:
            those = "; ".join(label(tuple(keys.loc[number])) for number in ours)
            raise ValueError(f"baseline: expected one row of {label(scene)} that matches, got {len(ours)}: {those}")
        found |= dict.fromkeys(members.index, ours[0] if ours else None)
    return [found[number] for number in keys.index]


def _scene_keys(rows: Sequence[str]) -> list[str]:
    return [key for key in rows if key in SCENES]


def interval(row: Any, text: Callable[..., str]) -> str:
    """`+0.52 [+0.10, +0.93] *`, see `statistics.stars`."""
    if pd.isna(row.seeds):
        return "baseline"
    if row.seeds == 0:
        return "no pairs"
    if isinf(row.low):
        return f"{text(row.mean, sign='+')} (one view)"
    mean, low, high = (text(x, sign="+") for x in (row.mean, row.low, row.high))
    return f"{mean} [{low}, {high}]" + (" *" if row.star else "")


def effect(row: Any) -> str:
    """Mean difference / its standard deviation over seeds."""
    return "" if pd.isna(row.effect) else f"{row.effect:+.1f}"


def pairs(row: Any) -> str:
    """Seeds x views that were paired."""
    return "" if pd.isna(row.seeds) else f"{row.seeds:.0f} x {row.views:.0f}"


def _line(first: pd.DataFrame, second: pd.DataFrame) -> list[float]:
    found = statistics.difference(statistics.paired(first, second))
    if found is None:
        return [0 if name in ("seeds", "views") else float("nan") for name in _COLUMNS]
    return list(astuple(found))
