"""Configurations as the points of a figure: one row each, with mean and spread over its seeds."""

import itertools
import re
from collections.abc import Iterable, Sequence
from string import ascii_lowercase

import pandas as pd

from qnerf.metrics import metric_of
from qnerf.records.schemas import LABELS

from ..selection import CIRCUITS, QUANTUM, settings

_NAME_LABELS = ("field", "encoder", "hash", "density", "color", "head", "sampler", "cameras", "train", "steps")
_NOTATIONS = {
    r"\b\d+L\d+S": "{}: circuit, L hidden layers, S re-uploadings",
    r"\b(?:[2-9]|\d\d+)x\d+\b": "{}: MLP, layers x width",
}


def points(runs: pd.DataFrame, values: Sequence[str], keep: Sequence[str] = ()) -> pd.DataFrame:
    """One row per scene and configuration of the runs; within a scene, the best mean of the first value comes first.

    Columns scene_name, `LABELS`, train.steps and `keep` of the first run; per value its mean and <value>_std (n - 1;
    NaN for one seed); n, the number of seeds; runs, their row numbers; name, a short text unlike that of any other row.
    """
    table = _grouped(runs, values, keep)
    return table.assign(name=names(table, runs))


def best(runs: pd.DataFrame, values: Sequence[str], most: int, never: Sequence[str] = ()) -> tuple[pd.DataFrame, str]:
    """`points` of the `most` best configurations of each scene, and a note that counts the others.

    never: labels that no name mentions.
    """
    table = _grouped(runs, values, ())
    shown = table.groupby("scene_name", dropna=False).head(most).reset_index(drop=True)
    left = len(table) - len(shown)
    rest = f"not drawn: {left} configurations of worse {metric_of(values[0]).label}" if left else ""
    return shown.assign(name=names(shown, runs, never=never)), rest


def families(table: pd.DataFrame, runs: pd.DataFrame, x: str, ignored: Sequence[str]) -> pd.DataFrame:
    """The rows of `points` that belong to a family with several values of `x`, numbered in the column `family`.

    A family is the configurations of a scene that differ in nothing but the `ignored` settings. A name such as
    "encoder." ignores every setting that starts with it.
    """
    keys = pd.concat([table["scene_name"], _settings(table, runs, ignored)], axis=1)
    table = table.assign(family=keys.groupby(list(keys.columns), sort=False, dropna=False).ngroup())
    return table[table.groupby("family")[x].transform("nunique") > 1].reset_index(drop=True)


def family_names(table: pd.DataFrame, runs: pd.DataFrame, ignored: Sequence[str]) -> pd.Series:
    """The name of each row's family, as `names` gives it to the family's first row."""
    firsts = table.drop_duplicates("family")
    texts = names(firsts, runs, ignored=ignored)
    return table["family"].map(dict(zip(firsts["family"], texts, strict=True)))


def names(
    table: pd.DataFrame,
    runs: pd.DataFrame,
    *,
    ignored: Sequence[str] = (),
    always: Sequence[str] = (),
    never: Sequence[str] = (),
    short: bool = False,
) -> pd.Series:
    """A short name for each row of `points`: the labels that differ, then, where labels are equal, every setting that
    differs. A name that told one of several would claim that this one made the difference.

    ignored: settings that no name mentions, as in `families`; always, never: labels that every name, or none, mentions;
    short: names with both heads do not say which is which.
    """
    labels = table.assign(
        hash=table["hash"].where(table["encoder"] == "hash", ""),
        steps=table["train.steps"].map("{:,.0f} steps".format, na_action="ignore"),
    )
    used = [key for key in _NAME_LABELS if key in always or (labels[key].nunique() > 1 and key not in never)]
    used = used or [key for key in ("color", "field") if key not in never][-1:]
    if not short and {"density", "color"} <= set(used):
        labels = labels.assign(density="density " + labels["density"], color="colour " + labels["color"])
    told = labels[used].fillna("").to_numpy()  # a label that a kind of run lacks
    texts = pd.Series([" ".join(filter(None, row)) for row in told], index=table.index, dtype=object)
    own = _settings(table, runs, ignored)
    several = own.groupby([table["scene_name"], texts], dropna=False).transform("nunique") > 1
    for key in several.columns[several.any()]:
        told = several[key] & (own[key] != "")
        texts = texts.where(~told, texts + f", {key}=" + own[key])
    return texts.str.removeprefix(", ")


def marked(table: pd.DataFrame, runs: pd.DataFrame, heads: Sequence[str]) -> tuple[pd.Series, str]:
    """A name for each row that is short enough for a figure's mark, and a note that says what its letters stand for.

    heads: labels that every name mentions. The field is told by colour or panel. Where rows have the same labels, a
    letter stands for the settings in which they differ.
    """
    parts = names(table, runs, always=heads, never=["field"], short=True).str.partition(", ")
    several = sorted(set(parts[2]) - {""})
    marks = (first + last for first, last in itertools.product(["", *ascii_lowercase], ascii_lowercase))  # a..z, aa..
    letters = dict(zip(several, marks, strict=False))
    texts = parts[0] + parts[2].map(lambda text: f" {letters[text]}" if text else "")
    key = [f"{letter}: {text}" for text, letter in letters.items()]
    order = "names: density head, colour head" if {"density", "color"} <= set(heads) else ""
    return texts, "; ".join(filter(None, [*key, order, notation(texts)]))


def notation(names: Iterable[str]) -> str:
    """What `1L2S` and `3x64` in these names mean, by an example each."""
    text = " ".join(names)
    found = {form: re.search(pattern, text) for pattern, form in _NOTATIONS.items()}
    return "; ".join(form.format(match[0]) for form, match in found.items() if match)


def _grouped(runs: pd.DataFrame, values: Sequence[str], keep: Sequence[str]) -> pd.DataFrame:
    keys = pd.concat([runs["scene_name"], settings(runs)], axis=1)
    groups = runs.groupby(keys.groupby(list(keys.columns), sort=False, dropna=False).ngroup())
    table = groups[list(dict.fromkeys(["scene_name", *LABELS, "train.steps", *keep]))].first()
    for value in values:
        table[value], table[f"{value}_std"] = groups[value].mean(), groups[value].std()
    table["n"] = groups.size()
    table["runs"] = pd.Series(groups.groups)
    ascending = [True, metric_of(values[0]).sign < 0]
    return table.sort_values(["scene_name", values[0]], ascending=ascending, ignore_index=True)


def _settings(table: pd.DataFrame, runs: pd.DataFrame, ignored: Sequence[str]) -> pd.DataFrame:
    """The `settings` of each row of `points`, without the ignored ones."""
    own = settings(runs.loc[[members[0] for members in table["runs"]]]).set_axis(table.index)
    return own.drop(columns=[key for key in map(str, own) if {key, key.split(".")[0] + "."} & set(ignored)])


def seeds(table: pd.DataFrame, drawn: str = "bars") -> str:
    """What the bars or bands mean: `bars: ± standard deviation over seeds, n = 2 to 3`, or `n = 1 seed: no bars`."""
    low, high = table["n"].min(), table["n"].max()
    if high == 1:
        return f"n = 1 seed: no {drawn}"
    several = f"n = {high}" if low == high else f"n = {low} to {high}"
    return f"{drawn}: ± standard deviation over seeds, {several}" + (f" (n = 1: no {drawn})" if low == 1 else "")


def kind(field: str, head: str | None = None) -> str:
    """`quantum` if the field has a circuit (as its `color` or `density` head, if one is named), else `classical`."""
    quantum = field in QUANTUM.get(str(head), CIRCUITS)
    return "quantum" if quantum else "classical"


def scenes(table: pd.DataFrame) -> list[str]:
    """The names of the scenes in alphabetical order."""
    return sorted(table["scene_name"].unique())
