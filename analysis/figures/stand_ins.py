"""The ladder: a circuit head and its cheaper stand-ins, against parameters and against seconds, with verdicts."""

from collections.abc import Mapping

import pandas as pd
from matplotlib.figure import Figure

from qnerf.metrics import metric_of
from qnerf.records import filters

from .. import style
from ..marks import Mark, write_names
from ..selection import select
from ..verdict import compare, evaluations, method, within_of
from . import points
from .forest import COLORS

PARTS = ("head", "density", "color")
CIRCUIT = r"\d+L\d+S"
"""The label of a QIREN head, which is the baseline where no other is given."""
NOT_WORSE = ("better", "equivalent", "not worse")


def stand_in_points(
    frame: pd.DataFrame,
    baseline: str | Mapping[str, object] | None = None,
    *,
    metric: str = "psnr",
    within: float | None = None,
) -> tuple[pd.DataFrame, str]:
    """A row a scene and rung, and the part of the field whose heads are the rungs: head, density or color.

    A rung is the label of a head. Of its configurations, such as learning rates, the best mean counts, on both sides.
    Columns scene_name, rung, `metric` and its _std, params, cpu_s (seconds of CPU in training), n, verdict, which is
    "baseline" for the baseline, and "not worse" where nothing else is decided and a loss of `within` is ruled out.
    ValueError where the heads do not differ, or a scene has no baseline.
    """
    runs = select(frame, metric).runs
    part = next((one for one in PARTS if runs[one].nunique() > 1), None)
    if part is None:
        raise ValueError(f"stand_ins compares several heads, got {len(runs)} runs of one; the sweep ladder trains some")
    runs = runs[runs[part].notna()]
    runs = runs.assign(cpu_s=runs["step_cpu_ms"] * runs["train.steps"] / 1000)
    table = points.points(runs, [metric, f"params.{part}", "cpu_s"])
    best_first = table.sort_values(["scene_name", metric], ascending=[True, metric_of(metric).sign < 0])
    table = best_first.drop_duplicates(["scene_name", part])
    table = table.rename(columns={f"params.{part}": "params"}).assign(rung=table[part]).reset_index(drop=True)
    if baseline is None:
        circuit = table["rung"].str.fullmatch(CIRCUIT)
    else:
        circuit = table.index.isin(filters.require(table, baseline, "rungs").index)
    views = evaluations(runs, metric)
    groups = [views.reindex(runs.loc[list(rows), "path"]).dropna(how="all") for rows in table["runs"]]
    verdicts: list[str] = []
    for number, scene in enumerate(table["scene_name"]):
        found = table.index[circuit & (table["scene_name"] == scene)]
        if len(found) != 1:
            raise ValueError(f"{scene}: expected one circuit, got {len(found)}: give --baseline, such as {part}=1L2S")
        others = int((table["scene_name"] == scene).sum()) - 1
        verdict = compare(
            groups[found[0]], groups[number], within_of(metric, within), metric=metric, comparisons=max(1, others)
        )[0]
        kind = "not worse" if verdict.excluded == "a loss" else verdict.kind
        verdicts.append("baseline" if number == found[0] else kind)
    columns = ["scene_name", "rung", metric, f"{metric}_std", "params", "cpu_s", "n", "verdict"]
    return table.assign(verdict=verdicts)[columns], part


def cheapest(table: pd.DataFrame, cost: str) -> str:
    """Which of a scene's rungs has the least `cost` and is one of `NOT_WORSE`, in words."""
    kept = table[table["verdict"].isin(NOT_WORSE)]
    if kept.empty:
        return "all undecided or worse"
    return f"cheapest not worse: {kept.loc[kept[cost].idxmin(), 'rung']}"


@style.styled
def stand_ins(
    frame: pd.DataFrame,
    baseline: str | Mapping[str, object] | None = None,
    *,
    metric: str = "psnr",
    within: float | None = None,
) -> Figure:
    """A mark a rung with its verdict against the circuit; a line of panels a scene: parameters, and CPU seconds.

    Arguments as `stand_in_points`.
    """
    table, part = stand_in_points(frame, baseline, metric=metric, within=within)
    scenes = points.scenes(table)
    figure = style.new(style.PAGE, 0.8 + 2.6 * len(scenes))
    axes = figure.subplots(len(scenes), 2, sharey="row", squeeze=False)
    drawn = []
    looks = {"baseline": (style.ink(), "*")} | {kind: (color, "o") for kind, color in COLORS.items()}
    looks["not worse"] = looks["equivalent"]
    for line, scene in zip(axes, scenes, strict=True):
        own = table[table["scene_name"] == scene]
        for ax, cost, heading in zip(line, ("params", "cpu_s"), ("parameters", "training, CPU s"), strict=True):
            for _, row in own.iterrows():
                color, marker = looks[row["verdict"]]
                name = f"{row['rung']}: {row['verdict']}"
                mark = Mark(ax, row[cost], row[metric], row[f"{metric}_std"], name)
                drawn.append(mark.draw(marker, color=color))
            ax.set(title=f"{scene}, {cheapest(own, cost)}", xlabel=heading)
            ax.margins(0.3, 0.15)
        line[0].set_ylabel(metric_of(metric).heading)
    what = {"head": "heads", "density": "density heads", "color": "colour heads"}[part]
    style.footnote(
        figure,
        f"{what}, each with its best settings; star: the baseline",
        points.seeds(table),
        method(metric, within_of(metric, within)),
        "not worse: a loss of that size is ruled out",
    )
    write_names(figure, drawn)
    return figure
