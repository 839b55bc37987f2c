"""Rows of the paper and our runs of the same architecture, side by side."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd
from qnerf.analysis.selection import label, refuse_mixtures, select
from qnerf.analysis.tables.seeds import aggregate, mean_and_spread
from qnerf.analysis.tables.table import Table

from qnerf.metrics import metric_of

SETTING = "paper: one run of one seed per row, nerfstudio's poster capture at 36 x 64, 30,000 steps"
_SETTINGS = ("scene_name", "encoder", "hash", "train", "train.steps", "train.rays")
_OURS = ("psnr", "ssim", "lpips")
_THEIRS = {"psnr": ("psnr_db", "{:.2f}"), "ssim": ("ssim", "{:.2f}"), "lpips": ("lpips", "{:g}")}  # as printed


def printed(name: str) -> pd.DataFrame:
    """The paper's rows from `<name>.csv` beside this file."""
    return pd.read_csv(Path(__file__).with_name(f"{name}.csv"))


def joined(paper: pd.DataFrame, frame: pd.DataFrame, keys: Sequence[str]) -> tuple[pd.DataFrame, tuple[str, ...]]:
    """The rows of `paper`, each with our finished runs that agree with it in all `keys`, and notes for under the table.

    The columns ours_<value>_<mean | std | n> and ours_seeds_n are added, 0 if there is no such run. The notes say which
    settings our runs had and what was left out. ValueError where the runs of a row mix scenes or configurations.
    """
    selection = select(frame)
    architectures = paper[list(keys)].dropna().drop_duplicates()
    ours = selection.runs.merge(architectures, on=list(keys))
    refuse_mixtures(ours, keys)
    measured = aggregate(ours, keys, _OURS)
    measured.columns = ["_".join(("ours", *name)) for name in measured.columns]
    table = paper.merge(measured.reset_index(), on=list(keys), how="left")
    table["ours_seeds_n"] = table["ours_seeds_n"].fillna(0).astype(int)
    settings = "; ".join(f"{key} {', '.join(map(label, ours[key].unique()))}" for key in _SETTINGS if key in ours)
    notes = [SETTING, f"ours: {settings}" if len(ours) else "ours: no run of these architectures"]
    others = len(selection.runs) - len(ours)
    if others:
        notes.append(f"{others} finished runs have an architecture that is not in this table")
    return table, (*notes, selection.note)


def side_by_side(title: str, table: pd.DataFrame, columns: Mapping[str, str], notes: Sequence[str]) -> Table:
    """A table of the paper's `columns` (name -> heading), each metric of the paper's beside ours, and our seeds."""
    text = pd.DataFrame({heading: _text(table[name], "{:,.0f}") for name, heading in columns.items()})
    bold = pd.DataFrame(index=text.index)
    for name in _OURS:
        (theirs, digits), heading = _THEIRS[name], metric_of(name).heading
        if theirs in table:
            text[f"{heading}: paper"] = _text(table[theirs], digits)
            bold[f"{heading}: paper"] = _best(table[theirs], name)
        ours = table[[f"ours_{name}_{column}" for column in ("mean", "std", "n")]]
        text[f"{heading}: ours"] = [
            mean_and_spread(name, *row, seeds)
            for row, seeds in zip(ours.to_numpy(), table["ours_seeds_n"], strict=True)
        ]
        bold[f"{heading}: ours"] = _best(table[f"ours_{name}_mean"], name)
    text["seeds"] = table["ours_seeds_n"].map(str)
    return Table(title, text, table, bold, tuple(notes))


def _text(column: pd.Series, form: str) -> pd.Series:
    if pd.api.types.is_numeric_dtype(column):
        return column.map(form.format, na_action="ignore").astype(object).fillna("")
    return column.fillna("").astype(str)


def _best(column: pd.Series, name: str) -> pd.Series:
    sign = metric_of(name).sign
    return (sign * column == (sign * column).max()) & (column.notna().sum() > 1)
