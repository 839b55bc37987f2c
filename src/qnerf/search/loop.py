"""The search itself: read the trials, propose more, train them, until there are enough."""

import time
from collections.abc import Callable, Sequence

from qnerf.search.history import NO_VALUE, History
from qnerf.search.space import Point
from qnerf.search.study import SAMPLERS, Options, Trial, propose

POLL = 10.0  # seconds between two looks at runs that another process trains


class NoObjective(Exception):
    """There is nothing to search by: no run has a number for an objective, or no view is held out for validation."""


def search(
    history: History,
    options: Options,
    launch: Callable[[Sequence[Point], Sequence[Trial]], None],
) -> list[Trial]:
    """Trains until there are `options.trials` trials, or the space has no more; returns them.

    launch: trains the runs of some points and returns when they have ended, well or not; it also gets the trials so
        far.

    Trials that were begun and that nobody trains come first. One whose run is still unfinished when it has been
    launched ends the search. Several processes share a search: each proposes what no other trains, and waits for the
    last ones.

    Raises:
        ValueError: no such sampler.
        NoObjective: runs have finished, and none of them has a number for one of the objectives.
    """
    if options.sampler not in SAMPLERS:
        raise ValueError(f"unknown sampler {options.sampler!r}; known: {', '.join(SAMPLERS)}")
    told = ""
    while True:
        trials = history.trials()
        if len(history.rejected) >= options.trials:
            return trials
        require_values(history.objectives, trials)
        unfinished = [trial for trial in trials if trial.state == "unfinished"]
        begun = [trial.point for trial in unfinished if not trial.running][: options.at_once]
        room = min(options.at_once - len(begun), options.trials - sum(bool(trial.runs) for trial in trials))
        fresh = propose(history.space, history.objectives, trials, max(room, 0), options, history.result)
        if not begun and not fresh:
            if not unfinished:
                return trials
            others = ", ".join(name for trial in unfinished for name in trial.runs)
            if others != told:
                print(f"note: waits for what other processes train: {others}", flush=True)
            told = others
            time.sleep(POLL)
            continue
        batch = [point for point in (*begun, *fresh) if history.ids(point)]
        if batch:
            launch(batch, trials)
        known = {history.result(trial.point): trial for trial in history.trials()}
        for point in batch:
            if history.result(point) not in known:
                history.reject(point, "")  # its job failed before the run began, and has told why
        left = [trial for point in begun if (trial := known.get(history.result(point))) and trial.state == "unfinished"]
        if left and len(left) == len(batch):
            if not any(trial.running for trial in left):
                return history.trials()
            time.sleep(POLL)


def require_values(objectives: Sequence[str], trials: Sequence[Trial]) -> None:
    """NoObjective if runs have finished, and none of them has a number for one of the objectives."""
    if any(trial.state == "finished" for trial in trials):
        return
    for name in objectives:
        if count := sum(trial.error == NO_VALUE.format(name) for trial in trials):
            runs = "the run that has finished has" if count == 1 else f"the {count} runs that have finished have"
            raise NoObjective(
                f"hydra.sweeper.objectives: {runs} no number for {name}, so there is nothing to search by"
            )
