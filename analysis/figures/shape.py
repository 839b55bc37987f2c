"""Quality against the depth and the width of a head."""

import pandas as pd
from matplotlib.figure import Figure

from qnerf.metrics import metric_of

from .. import style
from ..selection import check_keys, select
from . import points

_SETTINGS = {
    "depth": {"mlp": "mlp.layers", "qiren": "qiren.layers"},
    "width": {"mlp": "mlp.width", "qiren": "qiren.qubits"},
}
_AXES = {
    ("depth", "mlp"): "linear layers",
    ("depth", "qiren"): "hidden hybrid layers",
    ("width", "mlp"): "hidden units per layer",
    ("width", "qiren"): "qubits",
}


def shape_points(frame: pd.DataFrame, measure: str, head: str = "color") -> pd.DataFrame:
    """`points.points` of PSNR (dB) with `kind` (mlp | qiren), `x` (depth or width of the head) and `line`.

    The configurations of a line differ in x alone; those without such a partner are left out.

    Raises:
        ValueError: an unknown measure or head, or no two configurations differ in x alone.
    """
    if measure not in _SETTINGS or head not in style.HEADS:
        raise ValueError(f"expected depth or width of color or density, got {measure!r} of {head!r}")
    runs = select(frame).runs
    check_keys(runs, [f"{head}.name"])
    columns = {kind: f"{head}.{key}" for kind, key in _SETTINGS[measure].items()}
    runs = runs[runs[f"{head}.name"].isin(list(columns))]
    shape = [
        f"{head}.{key}" for key in ("name", "mlp.layers", "mlp.width", "qiren.layers", "qiren.spectral", "qiren.qubits")
    ]
    table = points.points(runs, ["psnr"], shape).rename(columns={f"{head}.name": "kind"})
    table["x"] = [float(row[columns[row["kind"]]]) for _, row in table.iterrows()]
    varied = [*columns.values(), "experiment"]  # an experiment acts through the settings that it changes
    table = points.families(table, runs, "x", varied)
    if table.empty:
        keys = ", ".join(columns.values())
        raise ValueError(f"no two configurations differ in the {measure} of the {style.HEADS[head]} alone ({keys})")
    labelled = table.assign(**{head: [_fixed(row, measure, head) for _, row in table.iterrows()]})
    for _, rows in labelled.groupby("kind"):
        table.loc[rows.index, "line"] = points.family_names(rows, runs, varied, [head])
    return table.sort_values(["scene_name", "kind", "line", "x"], ignore_index=True)


def _fixed(row: pd.Series, measure: str, head: str) -> str:
    """The part of the head's label that is the same along a line."""
    if row["kind"] == "qiren":
        spectral, layers = row[f"{head}.qiren.spectral"], row[f"{head}.qiren.layers"]
        return f"S = {spectral:.0f}" if measure == "depth" else f"{layers:.0f}L{spectral:.0f}S"
    return f"width {row[f'{head}.mlp.width']:.0f}" if measure == "depth" else f"{row[f'{head}.mlp.layers']:.0f} layers"


@style.styled
def psnr_vs_depth(frame: pd.DataFrame, head: str = "color") -> Figure:
    """PSNR against the depth of a head: a row per scene, MLPs left, circuits right, a line per width or S."""
    return _draw(frame, "depth", head)


@style.styled
def psnr_vs_width(frame: pd.DataFrame, head: str = "color") -> Figure:
    """PSNR against the width of a head: a row per scene, MLPs left, circuits right, a line per depth."""
    return _draw(frame, "width", head)


def _draw(frame: pd.DataFrame, measure: str, head: str) -> Figure:
    table = shape_points(frame, measure, head)
    kinds, scenes = sorted(table["kind"].unique()), points.scenes(table)
    fields = table.groupby(["kind", "line"])["field"].first()
    looks = dict(zip(fields.index, style.looks(fields), strict=True))
    figure = style.new(style.PAGE if len(kinds) > 1 else style.COLUMN, 0.5 + 2.0 * len(scenes))
    axes = figure.subplots(len(scenes), len(kinds), sharex="col", sharey="row", squeeze=False)
    for row, scene in zip(axes, scenes, strict=True):
        for ax, kind in zip(row, kinds, strict=True):
            shown = table[(table["scene_name"] == scene) & (table["kind"] == kind)]
            for line, group in shown.groupby("line"):
                ax.errorbar(group["x"], group["psnr"], group["psnr_std"], label=line, **looks[kind, line])
            ax.set_title(f"{scene}: {style.HEADS[head]}, {'circuits' if kind == 'qiren' else 'MLPs'}")
        row[0].set_ylabel(metric_of("psnr").heading)
    for ax, kind in zip(axes[-1], kinds, strict=True):
        ax.set_xlabel(_AXES[measure, kind])
        if measure == "width" and kind == "mlp":
            ax.set_xscale("log", base=2)
        ticks = sorted(table.loc[table["kind"] == kind, "x"].unique())
        ax.set_xticks(ticks, [f"{x:.0f}" for x in ticks])
    style.legend(figure)
    finished = select(frame)
    others = len(points.points(finished.runs, ["psnr"])) - len(table)
    what = "1 configuration that differs" if others == 1 else f"{others} configurations that differ"
    rest = f"not drawn: {what} in more than the {measure}" if others else ""
    style.footnote(figure, points.seeds(table), rest, finished.note)
    return figure
