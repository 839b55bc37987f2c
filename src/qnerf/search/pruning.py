"""Which runs a search gives up on the way. Every job judges itself, by what it reads in the store."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import optuna
from optuna.pruners import PercentilePruner
from optuna.trial import TrialState, create_trial

from qnerf.config.checks import is_number
from qnerf.search import objectives as goals
from qnerf.search.history import curve


@dataclass(frozen=True)
class Judge:
    """Gives a run up if its metric is worse than those of finished runs were after the same step.

    metric: what evaluations on the way measure. peers: ids of finished runs, in `store`. percentile: 50 gives up runs
        that are worse than the median of the peers, 25 only those in their worst quarter. least: nothing is given up
        with fewer peers. warmup: nothing is given up before this step.
    """

    store: Path
    metric: str
    peers: Sequence[str]
    percentile: float = 50.0
    least: int = 4
    warmup: int = 0

    def __call__(self, path: Path, step: int, measured: Mapping[str, Any]) -> bool:
        """Whether to give up the run of this folder, from the step and the means of its evaluation."""
        if not is_number(measured.get(self.metric)):
            return False
        study = optuna.create_study(direction=goals.direction(self.metric))
        curves = [curve(self.store / name, self.metric) for name in self.peers]
        study.add_trials([create_trial(value=0.0, intermediate_values=points) for points in curves])
        pruner = PercentilePruner(100 - self.percentile, self.least, self.warmup, n_min_trials=self.least)
        values = curve(path, self.metric) | {step: float(measured[self.metric])}
        running = create_trial(state=TrialState.RUNNING, intermediate_values=values)
        return bool(pruner.prune(study, running))
