"""The smallest configuration of each scene whose metric is within a tolerance of the best one."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from qnerf.metrics import metric_of

from ..selection import SCENES, label, select
from ..step_times import incomparable
from ..verdict import compare, measured, method, within_of
from .differences import interval
from .seeds import aggregate, mean_and_spread
from .table import Table


def smallest(
    frame: pd.DataFrame,
    rows: Sequence[str],
    *,
    metric: str = "psnr",
    within: float | None = None,
    size: str = "params.total",
) -> Table:
    """For each scene, the group of `rows` with the smallest mean `size` among those close to the best mean `metric`.

    within: how close, in the metric's unit; the metric may have one of its own. size: any number of a run, such as
    `params.total`, `params.color` or `step_ms`. The table shows the difference of the smallest group from the best and
    the verdict: the loss is shown to be that small where they are equivalent. Raises ValueError as `select` does,
    and for a size that is a time which is not comparable (`step_times.incomparable`).
    """
    within = within_of(metric, within)
    scenes = [key for key in rows if key in SCENES] or ["scene_name"]
    rows = [*scenes, *(key for key in rows if key not in scenes)]
    if len(rows) == len(scenes):
        raise ValueError(f"rows: expected a key that tells configurations apart, got only {', '.join(scenes)}")
    selection = select(frame, metric)
    sized = select(selection.runs, size, rows)
    if why := incomparable(sized.runs, size):
        raise ValueError(f"{why}; expected another size, such as params.total")
    data = _scenes(sized.runs, rows, scenes, metric, size, within)
    return Table(
        f"The smallest configuration of each scene within {within:g} of the best, by {metric_of(size).heading}",
        _text(data, metric, size, within),
        data,
        notes=(f"difference of the smallest from the best: {method(metric, within)}", selection.note, sized.note),
    )


def _scenes(
    runs: pd.DataFrame, rows: Sequence[str], scenes: Sequence[str], metric: str, size: str, within: float
) -> pd.DataFrame:
    table = aggregate(runs, rows, list(dict.fromkeys([metric, size])))
    keys = table.index.to_frame(index=False)
    names = keys[list(rows[len(scenes) :])].apply(lambda row: label(tuple(row)), axis=1)
    sign = metric_of(metric).sign
    quality, sizes = sign * table[(metric, "mean")].to_numpy(), table[(size, "mean")].to_numpy()
    group = runs.set_index("path").groupby(list(rows), dropna=False).ngroup()
    lines = []
    for scene, members in keys.groupby(list(scenes), dropna=False).indices.items():
        best = members[np.argmax(quality[members])]
        enough = members[quality[members] >= quality[best] - within]
        smallest = enough[np.lexsort((-quality[enough], sizes[enough]))[0]]
        line: dict[str, object] = {"scene": label(scene)}
        for part, number in (("best", best), ("smallest", smallest)):
            row = table.iloc[number]
            numbers = {f"{part}_{metric}_{column}": row[(metric, column)] for column in ("mean", "std", "n")}
            line |= {part: names[number], **numbers, f"{part}_size": sizes[number]}
        line |= {"difference": 0.0, "reach": 0.0, "verdict": "", "shown": ""}
        if best != smallest:
            views = [measured(runs[runs["path"].map(group) == number], metric) for number in (best, smallest)]
            found, _ = compare(views[0], views[1], within, metric=metric)
            line |= {"difference": found.difference, "reach": found.reach, "verdict": found.text(metric)}
            line["shown"] = interval(found, metric)
        lines.append(line)
    return pd.DataFrame(lines)


def _text(data: pd.DataFrame, metric: str, size: str, within: float) -> pd.DataFrame:
    text = pd.DataFrame({"scene": data["scene"]})
    for part, heading in (("best", "best"), ("smallest", f"smallest within {within:g}")):
        numbers = data[[f"{part}_{metric}_{column}" for column in ("mean", "std", "n")]]
        text[heading] = data[part]
        text[f"{part}: {metric_of(metric).heading}"] = [
            mean_and_spread(metric, *row, row[2]) for row in numbers.to_numpy()
        ]
        text[f"{part}: {metric_of(size).heading}"] = data[f"{part}_size"].map(metric_of(size).text)
    text["difference"], text["verdict"] = data["shown"], data["verdict"]
    return text
