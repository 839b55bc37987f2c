"""The first section of the page: a card for each scene with the verdict on each configuration."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from qnerf.metrics import metric_of

from ..decide.records import records
from ..figures.files import collecting
from ..selection import classical_baseline, main_metric, row_keys, select
from ..tables import across_scenes

MOST = 6  # configurations on a card


@dataclass(frozen=True)
class Verdicts:
    """Scene -> lines of configuration, verdict, difference, seeds, and what was searched; or why there are none."""

    cards: Mapping[str, list[tuple[str, ...]]] = field(default_factory=dict)
    note: str = ""
    absent: str = ""


def verdicts(
    frame: pd.DataFrame, baseline: str | None = None, metric: str | None = None, within: float | None = None
) -> Verdicts:
    """What studies have decided, then `across_scenes` of every setting that differs, by default against the classical
    configuration."""
    decided: dict[str, list[tuple[str, ...]]] = defaultdict(list)
    scenes = frame["scene_name"].dropna().unique()
    unnamed = str(scenes[0]) if len(scenes) == 1 else "decided"  # of a study without --scene
    unnamed = "all runs" if unnamed == "none" else unnamed
    for look in records(Path(str(frame["path"].iloc[0])).parent).to_dict("records"):
        if look["seeds"]:
            name, unit = f"{look['candidate']} - {look['baseline']}", metric_of(look["metric"]).unit
            seeds, difference = f"{look['seeds']} seeds, registered study", f"{look['shown']} {unit}".rstrip()
            decided[look["scene"] or unnamed].append((name, look["verdict"], difference, seeds, look["searched"]))
    errors: dict[str, str] = {}
    with collecting(errors, "verdicts"):
        metric = metric or main_metric(frame)
        runs = select(frame, metric).runs
        rows = row_keys(runs)
        reference = baseline or classical_baseline(runs, rows)
        table = across_scenes(runs, rows, reference, metric=metric, within=within)
        cards: dict[str, list[tuple[str, ...]]] = defaultdict(list)
        best = (table.data["difference"] * metric_of(metric).sign).sort_values(ascending=False, kind="stable").index
        for name, scene, difference, verdict, seeds in table.text.loc[best].itertuples(index=False):
            if seeds:  # else a mean over scenes, which the forest plot shows
                cards["all runs" if scene == "none" else scene].append(
                    (name, verdict, f"{difference} {metric_of(metric).unit or metric}", f"{seeds} seeds", "")
                )
        more = max(map(len, cards.values()), default=0) - MOST
        note = f"Of {more + MOST} configurations, the best {MOST} are here. " if more > 0 else ""
        said = table.notes[0]
        shown = {scene: decided.pop(scene, []) + cards[scene][:MOST] for scene in sorted(cards)}
        return Verdicts(shown | decided, f"{note}{said[0].upper()}{said[1:]}.")
    return Verdicts(decided, absent="" if decided else f"No verdict: {errors['verdicts']}")
