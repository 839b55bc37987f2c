"""Which runs a search gives up on the way. Every job judges itself, by what it reads in the store."""

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import optuna
from optuna.pruners import PercentilePruner
from optuna.trial import TrialState, create_trial

from qnerf.config.checks import is_number
from qnerf.records import StoreError, read_metrics, read_summary
from qnerf.search import objectives as goals
from qnerf.search.history import curve


@dataclass(frozen=True)
class Judge:
    """Gives a run up if its metric is worse than those of finished runs were after the same step.

    With several objectives, it is compared with runs that are no worse in each of the others: a small model may be
    worse than a large one.

    objectives: of the search. The first one that evaluations measure is judged; where there is none, nothing is given
        up. peers: ids of finished runs, in `store`. percentile: 50 gives up runs that are worse than the median of the
        peers, 25 only those in their worst quarter. least: nothing is given up with fewer peers. warmup: nothing is
        given up before this step.
    """

    store: Path
    objectives: Sequence[str]
    peers: Sequence[str]
    percentile: float = 50.0
    least: int = 4
    warmup: int = 0

    def __call__(self, path: Path, step: int, measured: Mapping[str, Any]) -> bool:
        """Whether to give up the run of this folder, from the step and the means of its evaluation."""
        metric = goals.judged(self.objectives)
        if metric is None or not is_number(measured.get(metric)):
            return False
        others = [name for name in self.objectives if name != metric]
        own = costs(path, others)
        folders = [self.store / name for name in self.peers]
        curves = [curve(folder, metric) for folder in folders if no_worse(costs(folder, others), own)]
        study = optuna.create_study(direction=goals.direction(metric))
        study.add_trials([create_trial(value=0.0, intermediate_values=points) for points in curves])
        pruner = PercentilePruner(100 - self.percentile, self.least, self.warmup, n_min_trials=self.least)
        values = curve(path, metric) | {step: float(measured[metric])}
        running = create_trial(state=TrialState.RUNNING, intermediate_values=values)
        return bool(pruner.prune(study, running))


def costs(path: Path, objectives: Sequence[str]) -> dict[str, float | None]:
    """The objectives of a run as far as they are known; the time of a step also before the run ends."""
    if not objectives:
        return {}
    try:
        summary = read_summary(path)
        if "step_ms" in objectives and not is_number(summary.get("step_ms")):
            logged = read_metrics(path)
            times = logged["value"][logged["key"] == "time/step_ms"].tolist()
            summary = summary | {"step_ms": statistics.median(times) if times else None}
    except StoreError:
        return dict.fromkeys(objectives)
    return {name: goals.value(summary, name) for name in objectives}


def no_worse(costs: Mapping[str, float | None], than: Mapping[str, float | None]) -> bool:
    """Whether every cost is known and at most as bad.

    >>> no_worse({"step_ms": 10.0}, {"step_ms": 12.0}), no_worse({"step_ms": None}, {"step_ms": 12.0})
    (True, False)
    """
    sign = {name: 1 if goals.direction(name) == "minimize" else -1 for name in costs}
    return all(
        (cost := costs[name]) is not None and (own := than[name]) is not None and sign[name] * (cost - own) <= 0
        for name in costs
    )
