"""The difference of each row of a table from a baseline row, with its verdict."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import pandas as pd

from qnerf.metrics import metric_of
from qnerf.records import filters

from ..selection import SCENES, label
from ..verdict import Verdict, compare, measured, method


def against(
    runs: pd.DataFrame,
    rows: Sequence[str],
    keys: pd.DataFrame,
    baseline: str | Mapping[str, object],
    metric: str,
    within: float,
) -> tuple[list[Verdict | None], list[str]]:
    """The verdict on each group of `rows`, in `groupby`'s order, against the baseline of its scene; notes for under it.

    keys: one row a group, its key. The baseline's own row has None.
    """
    reference = references(keys, rows, baseline)
    unmatched = keys[[base is None for base in reference]]
    numbers = runs.groupby(list(rows), dropna=False).ngroup()
    groups = {number: measured(runs[numbers == number], metric) for number in range(len(keys))}
    without = len(runs) - sum(map(len, groups.values()))
    pairs = {number: base for number, base in enumerate(reference) if base not in (None, number)}
    found = {
        number: compare(groups[base], groups[number], within, metric=metric, comparisons=len(pairs))
        for number, base in pairs.items()
    }
    names = [",".join(condition.values) for condition in filters.parse(baseline)]
    name = ", ".join(text for text in names if text not in ("nan", "none"))
    notes = [
        f"difference from {name}: {method(metric, within, views=any(own.shape[1] > 1 for own in groups.values()))}"
    ]
    if moved := max((other for _, other in found.values()), default=0):
        notes.append(f"other views: up to ± {metric_of(metric).text(moved)} more, whatever the number of seeds")
    if len(unmatched):
        scenes = dict.fromkeys(label(tuple(scene)) for scene in unmatched[_scene_keys(rows)].to_numpy())
        notes.append(f"no baseline in {', '.join(scenes)}")
    if without:
        notes.append(f"{without} runs have no readable {metric} in eval.parquet and take no part in the differences")
    return [found[number][0] if number in found else None for number in range(len(keys))], notes


def references(keys: pd.DataFrame, rows: Sequence[str], baseline: str | Mapping[str, object]) -> list[int | None]:
    """For each row of `keys` the number of its scene's baseline row; None where the scene has none.

    ValueError where no scene has one, or a scene has several.
    """
    for condition in filters.parse(baseline):
        try:
            filters.check_column(condition.key, rows)
        except ValueError:
            known = ", ".join(rows)
            raise ValueError(f"baseline: {condition.key!r} is not a row key; the rows are {known}") from None
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


def interval(found: Verdict, metric: str) -> str:
    """`+0.52 ± 0.41`; without the interval where a side has a single run."""
    text = metric_of(metric).text
    if pd.isna(found.difference):
        return "no common views"
    reach = f" ± {text(found.reach)}" if found.freedom else " (one seed)"
    return text(found.difference, sign="+") + reach


def as_numbers(found: Sequence[Verdict | None]) -> pd.DataFrame:
    """The verdicts as numbers, a row each."""
    empty = dict.fromkeys(asdict(Verdict("undecided", 0, 0, 0, 0, 0)))
    return pd.DataFrame([empty if one is None else asdict(one) for one in found])
