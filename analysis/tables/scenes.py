"""Differences from a baseline across scenes: a row a scene, and means over these scenes and over scenes like them."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import NamedTuple

import pandas as pd

from qnerf.metrics import metric_of

from ..selection import SCENES, check_keys, label, refuse_mixtures, select
from ..verdict import Verdict, over_scenes_like_these, over_these_scenes, within_of
from .differences import against, interval
from .table import Table


class Compared(NamedTuple):
    """The verdict on a configuration of one scene against the scene's baseline, or on means over scenes."""

    configuration: str
    scene: str
    verdict: Verdict


def compared(
    frame: pd.DataFrame,
    rows: Sequence[str],
    baseline: str | Mapping[str, object],
    *,
    metric: str = "psnr",
    within: float | None = None,
) -> tuple[list[Compared], list[str]]:
    """Each configuration in each scene, then its means over scenes if there are several; notes for under them.

    rows: as of `ablation`, with a key that names the scene. Raises ValueError as `ablation` does.
    """
    check_keys(frame, rows)
    scenes, others = ([key for key in rows if (key in SCENES) == wanted] for wanted in (True, False))
    if not scenes or not others:
        raise ValueError(f"rows: expected scene_name and a key that tells configurations apart, got {', '.join(rows)}")
    selection = select(frame, metric)
    refuse_mixtures(selection.runs, rows)
    keys = selection.runs.groupby(list(rows), dropna=False).size().index.to_frame(index=False)
    least = within_of(metric, within)
    verdicts, notes = against(selection.runs, rows, keys, baseline, metric, least)
    lines: list[Compared] = []
    telling = [key for key in others if keys[key].nunique(dropna=False) > 1] or others
    for _, members in keys.groupby(others, dropna=False, sort=False):
        name = label(tuple(keys.loc[members.index[0], telling]))
        found = {label(tuple(keys.loc[n, scenes])): verdicts[n] for n in members.index if verdicts[n] is not None}
        lines += [Compared(name, scene, verdict) for scene, verdict in found.items()]
        own = [verdict for verdict in found.values() if verdict.freedom]
        if len(own) > 1:
            sign = metric_of(metric).sign
            lines.append(Compared(name, f"mean of these {len(own)}", over_these_scenes(own, sign=sign)))
        if len(own) > 2:
            lines.append(Compared(name, "scenes like them", over_scenes_like_these(own, sign=sign)))
    return lines, [*notes, *filter(None, [selection.note])]


def across_scenes(
    frame: pd.DataFrame,
    rows: Sequence[str],
    baseline: str | Mapping[str, object],
    *,
    metric: str = "psnr",
    within: float | None = None,
) -> Table:
    """`compared` as a table; under it how many scenes have which verdict. Raises ValueError as `ablation` does."""
    lines, notes = compared(frame, rows, baseline, metric=metric, within=within)
    text = pd.DataFrame({"configuration": [line.configuration for line in lines], "scene": [x.scene for x in lines]})
    text[f"difference, {metric_of(metric).heading}"] = [interval(line.verdict, metric) for line in lines]
    text["verdict"] = [line.verdict.text(metric) for line in lines]
    text["seeds"] = ["{} / {}".format(*line.verdict.seeds) if any(line.verdict.seeds) else "" for line in lines]
    data = pd.DataFrame([{"configuration": x.configuration, "scene": x.scene, **asdict(x.verdict)} for x in lines])
    for name in dict.fromkeys(line.configuration for line in lines):
        counts = Counter(x.verdict.kind for x in lines if x.configuration == name and any(x.verdict.seeds))
        notes.append(f"{name}: " + ", ".join(f"{kind} on {count}" for kind, count in counts.items()))
    bold = pd.DataFrame(False, index=text.index, columns=text.columns)
    return Table("Differences across scenes", text, data, bold, tuple(notes))
