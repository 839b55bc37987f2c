"""Differences from a baseline across scenes: a row a scene, and means over these scenes and over scenes like them."""

from collections import Counter
from collections.abc import Mapping, Sequence

import pandas as pd

from qnerf.metrics import metric_of

from ..selection import SCENES, label, select
from ..verdict import Verdict, over_scenes, within_of
from .differences import against, as_numbers, interval
from .table import Table


def across_scenes(
    frame: pd.DataFrame,
    rows: Sequence[str],
    baseline: str | Mapping[str, object] | None = None,
    *,
    metric: str = "psnr",
    within: float | None = None,
) -> Table:
    """The verdict on each configuration in each scene, then on its means over scenes if there are several.

    rows: as of `ablation`, with a key that names the scene. Notes count the verdicts. Rows of `data` that are means
    have no seeds. Raises ValueError as `ablation` does.
    """
    if baseline is None:
        raise ValueError("differences across scenes need a baseline, --baseline KEY=VALUE,...")
    scenes, others = ([key for key in rows if (key in SCENES) == wanted] for wanted in (True, False))
    if not scenes or not others:
        raise ValueError(f"rows: expected scene_name and a key that tells configurations apart, got {', '.join(rows)}")
    selection = select(frame, metric, rows)
    keys = selection.runs.groupby(list(rows), dropna=False).size().index.to_frame(index=False)
    verdicts, notes = against(selection.runs, rows, keys, baseline, metric, within_of(metric, within, 0))
    notes.append(selection.note)
    telling = [key for key in others if keys[key].nunique(dropna=False) > 1] or others
    called = keys[telling].apply(lambda row: label(tuple(row.dropna())), axis=1)
    if called.nunique() < keys[telling].drop_duplicates().shape[0]:
        called = keys[telling].apply(lambda row: label(tuple(row)), axis=1)
    lines: list[tuple[str, str, Verdict]] = []
    for _, members in keys.groupby(others, dropna=False, sort=False):
        name = called[members.index[0]]
        own = {label(tuple(keys.loc[row, scenes])): found for row in members.index if (found := verdicts[row])}
        if not own:
            continue
        lines += [(name, scene, found) for scene, found in own.items()]
        counts = Counter(found.kind for found in own.values())
        notes.append(f"{name}: " + ", ".join(f"{kind} on {count}" for kind, count in counts.items()))
        known = [found for found in own.values() if found.freedom]
        if len(known) > 1:
            means = over_scenes(known, sign=metric_of(metric).sign)
            titles = (f"mean of these {len(known)}", "scenes like them")
            lines += [(name, *line) for line in zip(titles, means, strict=False)]
    names = pd.DataFrame([line[:2] for line in lines], columns=["configuration", "scene"])
    found = [line[2] for line in lines]
    text = names.assign(
        **{
            f"difference, {metric_of(metric).heading}": [interval(one, metric) for one in found],
            "verdict": [one.text(metric) for one in found],
            "seeds": ["{} / {}".format(*one.seeds) if any(one.seeds) else "" for one in found],
        }
    )
    return Table("Differences across scenes", text, names.join(as_numbers(found)), notes=tuple(notes))
