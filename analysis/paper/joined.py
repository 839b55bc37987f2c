"""Rows of the paper and our runs of the same architecture, side by side."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from qnerf.metrics import metric_of

from ..selection import label, refuse_mixtures, select
from ..tables.seeds import aggregate, mean_and_spread
from ..tables.table import Table

SETTING = "paper: one run and one seed a row, nerfstudio's poster capture at 36 x 64, 30,000 steps"
_SAID = ("scene_name", "encoder", "hash", "train", "train.steps", "train.rays")
_OURS = ("psnr", "ssim", "lpips")
_THEIRS = {"psnr": ("psnr_db", "{:.2f}"), "ssim": ("ssim", "{:.2f}"), "lpips": ("lpips", "{:g}")}  # as printed


def printed(name: str) -> pd.DataFrame:
    """The paper's rows from `<name>.csv` beside this file."""
    return pd.read_csv(Path(__file__).with_name(f"{name}.csv"))


def joined(paper: pd.DataFrame, frame: pd.DataFrame, keys: Sequence[str]) -> tuple[pd.DataFrame, tuple[str, ...]]:
    """`paper` with our (value, mean | std | n) of the finished runs that agree in all `keys`, columns of both.

    The seeds are 0 where there is no such run. Also gives the notes: what was left out, and which settings ours had.
    ValueError where the runs of a row mix scenes or configurations.
    """
    selection = select(frame)
    known = paper[list(keys)].dropna().drop_duplicates()
    ours = selection.runs.merge(known, on=list(keys))
    refuse_mixtures(ours, keys)
    measured = aggregate(ours, keys, _OURS)
    measured.columns = ["_".join(("ours", *name)) for name in measured.columns]
    table = paper.merge(measured.reset_index(), on=list(keys), how="left")
    table["ours_seeds_n"] = table["ours_seeds_n"].fillna(0).astype(int)
    said = "; ".join(f"{key} {', '.join(map(label, ours[key].unique()))}" for key in _SAID if key in ours)
    notes = [SETTING, f"ours: {said}" if len(ours) else "ours: no run of these architectures"]
    elsewhere = len(selection.runs) - len(ours)
    if elsewhere:
        notes.append(f"{elsewhere} finished runs are of no architecture of this table")
    return table, (*notes, *filter(None, [selection.note]))


def side_by_side(
    title: str, table: pd.DataFrame, columns: Mapping[str, str], notes: Sequence[str], form: str = "{:,.0f}"
) -> Table:
    """The paper's `columns` (name -> heading), then the paper's and our metrics in pairs, then our number of seeds.

    Numbers among `columns` are printed with `form`.
    """
    text = pd.DataFrame({heading: _text(table[name], form) for name, heading in columns.items()})
    bold = pd.DataFrame(False, index=text.index, columns=text.columns)
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
    bold = bold.reindex(columns=text.columns, fill_value=False)
    return Table(title, text, table, bold, tuple(notes))


def _text(column: pd.Series, form: str) -> pd.Series:
    if pd.api.types.is_numeric_dtype(column):
        return column.map(form.format, na_action="ignore").astype(object).fillna("")
    return column.fillna("").astype(str)


def _best(column: pd.Series, name: str) -> pd.Series:
    sign = metric_of(name).sign
    return (sign * column == (sign * column).max()) & (column.notna().sum() > 1)
