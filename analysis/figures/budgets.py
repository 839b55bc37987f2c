"""Quality against the time of whole trainings."""

import pandas as pd
from matplotlib.figure import Figure

from qnerf.metrics import metric_of

from .. import style
from ..selection import select
from ..step_times import incomparable
from . import points


def time_points(frame: pd.DataFrame) -> pd.DataFrame:
    """`points.points` of PSNR (dB) and `train_s`, with `line`: those of a line differ in train.steps alone.

    Each point is the end of trainings, since a learning rate is planned for its number of steps. ValueError where no
    two configurations differ in the steps alone.
    """
    runs = select(select(frame).runs, "train_s").runs
    table = points.families(points.points(runs, ["psnr", "train_s"]), runs, "train.steps", ["train.steps"])
    if table.empty:
        raise ValueError("no two configurations differ in train.steps alone; train.steps=750,1500,3000 sweeps over it")
    one = table.assign(**{"train.steps": 0})  # so that no name mentions them
    return table.assign(line=points.family_names(one, runs, ["train.steps"])).sort_values("train.steps")


@style.styled
def psnr_vs_time(frame: pd.DataFrame) -> Figure:
    """PSNR of held-out views at the end against seconds of training, a panel per scene, a line per configuration."""
    table = time_points(frame)
    figure, axes = style.panels(table["scene_name"].nunique(), 2.6)
    fields = table.groupby("line", sort=False)["field"].first()
    looks = dict(zip(fields.index, style.looks(fields), strict=True))
    for ax, (scene, shown) in zip(axes, table.groupby("scene_name"), strict=True):
        for line, rows in shown.groupby("line", sort=False):
            ax.errorbar(rows["train_s"], rows["psnr"], rows["psnr_std"], elinewidth=0.7, label=line, **looks[line])
        ax.set(title=scene, xlabel=metric_of("train_s").heading, xscale="log")
        style.plain_ticks(ax)
    axes[0].set_ylabel(metric_of("psnr").heading)
    style.legend(figure)
    selection = select(frame)
    note = points.notation(table["line"])
    style.footnote(figure, points.seeds(table, "bars"), note, incomparable(selection.runs, "train_s"), selection.note)
    return figure
