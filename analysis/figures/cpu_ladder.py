"""What seconds of CPU buy, of this project and of its peers."""

import pandas as pd
from matplotlib.figure import Figure

from qnerf.metrics import metric_of

from .. import style
from ..step_times import LOAD_RATIO
from . import benchmarks


def cpu_ladder_points(results: benchmarks.Results = None) -> pd.DataFrame:
    """Means over the seeds of the benchmark cpu_ladder, a row per scene, width, case and budget.

    Columns scene, width (pixels), case, budget_s, seconds (of training, as measured), psnr (dB), psnr_std (NaN for one
    seed), n. What could not be trained is left out.
    """
    trained = benchmarks.read("cpu_ladder", results).dropna(subset=["psnr"])
    groups = trained.groupby(["scene", "width", "case", "budget_s"], sort=False)
    return groups[["seconds", "psnr"]].mean().assign(psnr_std=groups["psnr"].std(), n=groups.size()).reset_index()


@style.styled
def psnr_vs_cpu_seconds(results: benchmarks.Results = None) -> Figure:
    """PSNR of held-out views against seconds of training, a panel for each scene and width.

    Every point is a training of its own.
    """
    rows = benchmarks.read("cpu_ladder", results)
    table = cpu_ladder_points(rows)
    panels = sorted(set(zip(table["scene"], table["width"], strict=True)))
    cases = sorted(set(table["case"]))
    figure, axes = style.panels(len(panels), 2.4, sharex=True, sharey=True)
    for ax, (scene, width) in zip(axes, panels, strict=True):
        shown = table[(table["scene"] == scene) & (table["width"] == width)]
        for case, part in shown.sort_values("budget_s").groupby("case"):
            look = style.series(cases.index(case)) | {"ls": "--" if "qnerf" not in str(case) else "-"}
            ax.errorbar(part["seconds"], part["psnr"], part["psnr_std"], label=case, elinewidth=0.7, **look)
        ax.set(title=f"{scene}, {width} px", xscale="log")
        ax.set_xlabel("training, CPU s" if set(rows["threads"]) == {1} else "training, s")
        style.plain_ticks(ax)
        ax.tick_params(labelbottom=True)
    for ax in axes[::3]:
        ax.set_ylabel(metric_of("eval/psnr").heading)
    style.legend(figure)
    load = rows["load"][rows["threads"] > 1].dropna().clip(lower=1)
    busy = f"not comparable: loads of {load.min():.1f} to {load.max():.1f}" if _differ(load) else ""
    threads = ", ".join(map(str, sorted(set(rows["threads"]))))
    style.footnote(figure, f"threads: {threads}; dashed: peers and plain references", busy)
    return figure


def _differ(load: pd.Series) -> bool:
    return bool(load.max() > LOAD_RATIO * load.min())
