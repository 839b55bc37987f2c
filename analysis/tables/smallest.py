"""The smallest configuration of each scene whose metric is within a tolerance of the best one."""

from collections.abc import Callable, Sequence
from math import isinf

import numpy as np
import pandas as pd

from qnerf.metrics import metric_of, quality_metrics

from .. import statistics
from ..selection import SCENES, check_keys, label, refuse_mixtures, select
from ..step_times import doubt
from .seeds import aggregate, mean_and_spread
from .table import Table

TOLERANCE = 0.5  # dB


def smallest(
    frame: pd.DataFrame,
    rows: Sequence[str],
    *,
    metric: str = "psnr",
    tolerance: float = TOLERANCE,
    size: str = "params.total",
) -> Table:
    """For each scene, the group of `rows` with the smallest mean `size` among those close to the best mean `metric`.

    tolerance: how close, in the metric's unit. size: any number of a run, such as `params.total`, `params.color` or
    `step_ms`. The table shows how much worse the smallest group is than the best, with the interval of
    `statistics.difference`. The loss is `shown` to be within the tolerance where the whole interval is. Raises
    ValueError as `over_seeds` does, for a tolerance below 0, and for a size that is a time which is not comparable
    (`step_times.doubt`).
    """
    if not tolerance >= 0:
        raise ValueError(f"tolerance must be at least 0, got {tolerance}")
    if metric_of(metric) not in quality_metrics():
        known = ", ".join(item.key for item in quality_metrics())
        raise ValueError(f"{metric} does not tell how good a run is; expected {known}")
    check_keys(frame, rows)
    scenes = [key for key in rows if key in SCENES] or ["scene_name"]
    rows = [*scenes, *(key for key in rows if key not in scenes)]
    if len(rows) == len(scenes):
        raise ValueError(f"rows: expected a key that tells configurations apart, got only {', '.join(scenes)}")
    selection = select(frame, metric)
    sized = select(selection.runs, size)
    refuse_mixtures(sized.runs, rows)
    if why := doubt(sized.runs, size):
        raise ValueError(f"{why}; expected another size, such as params.total")
    data = _scenes(sized.runs, rows, scenes, metric, size, tolerance)
    left = [part.note for part in (selection, sized) if part.note]
    method = f"loss of the smallest against the best: {statistics.method()}"
    return Table(
        f"The smallest configuration of each scene within {tolerance:g} of the best, by {metric_of(size).heading}",
        text := _text(data, metric, size, tolerance),
        data,
        pd.DataFrame(False, index=text.index, columns=text.columns),
        (method, *left),
    )


def _scenes(
    runs: pd.DataFrame, rows: Sequence[str], scenes: Sequence[str], metric: str, size: str, tolerance: float
) -> pd.DataFrame:
    table = aggregate(runs, rows, list(dict.fromkeys([metric, size])))
    keys = table.index.to_frame(index=False)
    names = keys[list(rows[len(scenes) :])].apply(lambda row: label(tuple(row)), axis=1)
    sign = metric_of(metric).sign
    quality, sizes = sign * table[(metric, "mean")].to_numpy(), table[(size, "mean")].to_numpy()
    group = dict(zip(runs["path"], runs.groupby(list(rows), dropna=False).ngroup(), strict=True))
    lines = []
    for scene, members in keys.groupby(list(scenes), dropna=False).indices.items():
        best = members[np.argmax(quality[members])]
        enough = members[quality[members] >= quality[best] - tolerance]
        smallest = enough[np.lexsort((-quality[enough], sizes[enough]))[0]]
        line: dict[str, object] = {"scene": label(scene)}
        for part, number in (("best", best), ("smallest", smallest)):
            row = table.iloc[number]
            numbers = {f"{part}_{metric}_{column}": row[(metric, column)] for column in ("mean", "std", "n")}
            line |= {part: names[number], **numbers, f"{part}_size": sizes[number]}
        chosen = runs[runs["path"].map(group).isin([best, smallest])]
        lines.append(line | _loss(chosen, group, best, smallest, metric, sign, tolerance))
    data = pd.DataFrame(lines)
    return data.assign(star=statistics.stars(data["loss_p"].tolist(), data["loss_seeds"].tolist()))


def _loss(
    runs: pd.DataFrame, group: dict[str, int], best: int, smallest: int, metric: str, sign: int, tolerance: float
) -> dict[str, object]:
    nothing = {f"loss_{name}": float("nan") for name in ("low", "high", "p", "seeds")}
    if best == smallest:
        return {"loss": 0.0, **nothing, "shown": True}
    views = statistics.evaluations(runs, metric)
    number = views["path"].map(group)
    found = statistics.difference(sign * statistics.paired(views[number == smallest], views[number == best]))
    if found is None:
        return {"loss": float("nan"), **nothing, "shown": False}
    bounds = {"loss_low": found.low, "loss_high": found.high, "loss_p": found.p, "loss_seeds": found.seeds}
    return {"loss": found.mean, **bounds, "shown": found.high <= tolerance}


def _text(data: pd.DataFrame, metric: str, size: str, tolerance: float) -> pd.DataFrame:
    text = pd.DataFrame({"scene": data["scene"]})
    for part, heading in (("best", "best"), ("smallest", f"smallest within {tolerance:g}")):
        numbers = data[[f"{part}_{metric}_{column}" for column in ("mean", "std", "n")]]
        text[heading] = data[part]
        text[f"{part}: {metric_of(metric).heading}"] = [
            mean_and_spread(metric, *row, row[2]) for row in numbers.to_numpy()
        ]
        text[f"{part}: {metric_of(size).heading}"] = data[f"{part}_size"].map(metric_of(size).text)
    text["loss"] = [_interval(row, metric_of(metric).text) for row in data.to_dict("records")]
    text[f"within {tolerance:g}"] = data["shown"].map({True: "whole interval", False: "mean only"})
    return text


def _interval(row: dict[str, float], text: Callable[[float], str]) -> str:
    if pd.isna(row["loss_low"]):
        return "" if row["loss"] == 0 else "no pairs"
    if isinf(row["loss_low"]):
        return f"{text(row['loss'])} (one view)"
    loss, low, high = (text(row[name]) for name in ("loss", "loss_low", "loss_high"))
    return f"{loss} [{low}, {high}]" + (" *" if row["star"] else "")
