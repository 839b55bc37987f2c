"""The first section of the page: a card for each scene with the verdict on each configuration."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field

import pandas as pd

from qnerf.metrics import metric_of

from ..figures.files import collecting
from ..selection import classical_baseline, main_metric, row_keys, select
from ..tables import across_scenes

MOST = 6  # configurations on a card


@dataclass(frozen=True)
class Verdicts:
    """Scene -> lines of configuration, verdict, difference and seeds; or why there are none."""

    cards: Mapping[str, list[tuple[str, ...]]] = field(default_factory=dict)
    note: str = ""
    absent: str = ""


def verdicts(
    frame: pd.DataFrame, baseline: str | None = None, metric: str | None = None, within: float | None = None
) -> Verdicts:
    """`across_scenes` of every setting that differs, by default against the classical configuration."""
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
                cards[scene].append(
                    (name, verdict, f"{difference} {metric_of(metric).unit or metric}", f"{seeds} seeds")
                )
        more = max(map(len, cards.values()), default=0) - MOST
        note = f"Of {more + MOST} configurations, the best {MOST} are here. " if more > 0 else ""
        said = table.notes[0]
        return Verdicts({scene: cards[scene][:MOST] for scene in sorted(cards)}, f"{note}{said[0].upper()}{said[1:]}.")
    return Verdicts(absent=f"No verdict: {errors['verdicts']}")
