"""Runs as the points and lines of a figure: one for each configuration, with mean and spread over its seeds."""

from collections.abc import Sequence

import pandas as pd

from ..settings import LABELS, effective

_NAMING = ("field", "encoder", "hash", "density", "color", "sampler", "cameras", "train", "steps")


def points(runs: pd.DataFrame, values: Sequence[str], keep: Sequence[str] = ()) -> pd.DataFrame:
    """One row for each scene and configuration of `select`'s runs, best mean of the first value first within a scene.

    Columns: scene_name, `LABELS`, `keep` (the first run's), <value>, <value>_std (n - 1; NaN for one seed), n, name
    (what tells the configuration from the others) and runs (their row numbers).
    """
    table = _grouped(runs, values, keep)
    return table.assign(name=names(table, runs))


def best(runs: pd.DataFrame, values: Sequence[str], most: int) -> tuple[pd.DataFrame, str]:
    """`points` of the `most` best configurations of each scene, and a note about the others."""
    table = _grouped(runs, values, ())
    kept = table.groupby("scene_name").head(most).reset_index(drop=True)
    left = len(table) - len(kept)
    return kept.assign(name=names(kept, runs)), f"not drawn: {left} configurations of lower PSNR" if left else ""


def families(table: pd.DataFrame, runs: pd.DataFrame, apart: Sequence[str]) -> pd.Series:
    """A number for each row of `points`: the same where configurations of a scene differ in nothing but `apart`.

    apart: settings, or first parts of their names with a dot behind.
    """
    keys = pd.concat([table["scene_name"], _settings(table, runs, apart)], axis=1)
    return keys.groupby(list(keys.columns), sort=False).ngroup()


def names(
    table: pd.DataFrame, runs: pd.DataFrame, *, apart: Sequence[str] = (), always: Sequence[str] = ()
) -> pd.Series:
    """Short names for rows of `points`: the labels that differ, and where those are not enough the settings that do.

    `apart`: settings, as in `families`, that no name tells; `always`: labels that every name tells.
    """
    used = table.assign(
        hash=table["hash"].where(table["encoder"] == "hash", ""),
        steps=table["train.steps"].map("{:,.0f} steps".format),
    )
    told = [key for key in _NAMING if key in always or used[key].nunique() > 1] or ["field"]
    texts = used[told].agg(lambda row: " ".join(filter(None, row)), axis=1)
    settings = _settings(table, runs, apart)
    for key in settings:
        groups = pd.DataFrame({"scene": table["scene_name"], "text": texts, "value": settings[key]})
        several = groups.groupby(["scene", "text"])["value"].transform("nunique") > 1
        texts = texts.where(~several, texts + f", {key}=" + settings[key])
    return texts


def _grouped(runs: pd.DataFrame, values: Sequence[str], keep: Sequence[str]) -> pd.DataFrame:
    keys = pd.concat([runs["scene_name"], effective(runs)], axis=1)
    number = keys.groupby(list(keys.columns), sort=False).ngroup()
    groups = runs.groupby(number)
    table = groups[list(dict.fromkeys(["scene_name", *LABELS, "train.steps", *keep]))].first()
    for value in values:
        table[value], table[f"{value}_std"] = groups[value].mean(), groups[value].std()
    table["n"] = groups.size()
    table["runs"] = pd.Series(groups.groups)
    return table.sort_values(["scene_name", values[0]], ascending=[True, False], ignore_index=True)


def _settings(table: pd.DataFrame, runs: pd.DataFrame, apart: Sequence[str]) -> pd.DataFrame:
    """The `effective` settings of each row of `points`, without those in `apart`."""
    settings = effective(runs.loc[[members[0] for members in table["runs"]]]).set_axis(table.index)
    return settings.drop(columns=[key for key in settings if key in apart or f"{key.split('.')[0]}." in apart])


def seeds(table: pd.DataFrame, drawn: str = "bars") -> str:
    """What the bars or bands mean: `bars: ± standard deviation over seeds, n = 2 to 3`, or `n = 1 seed: no bars`."""
    low, high = table["n"].min(), table["n"].max()
    if high == 1:
        return f"n = 1 seed: no {drawn}"
    several = f"n = {high}" if low == high else f"n = {low} to {high}"
    return f"{drawn}: ± standard deviation over seeds, {several}" + (f" (n = 1: no {drawn})" if low == 1 else "")


def kind(field: str) -> str:
    """Whether a run has a circuit: `quantum` or `classical`."""
    return "classical" if field == "classical" else "quantum"


def scenes(table: pd.DataFrame) -> list[str]:
    """The scenes, one panel each, by name."""
    return sorted(table["scene_name"].unique())
