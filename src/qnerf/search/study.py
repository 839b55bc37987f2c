"""Trials, and Optuna's study of them: what to try next is a function of the trials so far."""

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import optuna
from optuna.importance import PedAnovaImportanceEvaluator, get_param_importances
from optuna.samplers import BaseSampler, GPSampler, RandomSampler, TPESampler
from optuna.trial import FrozenTrial, TrialState, create_trial

from qnerf.search import objectives as goals
from qnerf.search.space import Point, Space

REPEATS = 20  # proposals of what was tried already, after which points are drawn at random
DRAWS = 300  # random points, after which the space counts as tried to its end

SAMPLERS: Mapping[str, Callable[[int, int], BaseSampler]] = {
    "tpe": lambda startup, seed: TPESampler(n_startup_trials=startup, seed=seed, constant_liar=True),
    "gp": lambda startup, seed: GPSampler(n_startup_trials=startup, seed=seed),
    "random": lambda startup, seed: RandomSampler(seed=seed),
}
"""Name -> Optuna's sampler, from the number of random trials before it learns, and its seed."""

State = Literal["finished", "pruned", "failed", "unfinished"]

_STATES = {
    "finished": TrialState.COMPLETE,
    "pruned": TrialState.PRUNED,
    "failed": TrialState.PRUNED,  # the worst there is; samplers learn nothing from FAIL and would propose it again
    "unfinished": TrialState.RUNNING,
}

optuna.logging.set_verbosity(optuna.logging.WARNING)


@dataclass(frozen=True)
class Trial:
    """One point of the space and what its runs gave.

    values: of each objective, the mean over the runs; empty unless finished. curve: step -> the judged metric of a
        pruned trial. runs: ids, one a seed. running: whether a process trains one of them. error: why it failed.
    """

    point: Point
    state: State
    values: tuple[float, ...] = ()
    runs: tuple[str, ...] = ()
    curve: Mapping[int, float] = field(default_factory=dict)
    running: bool = False
    error: str = ""


@dataclass(frozen=True)
class Options:
    """How to search.

    trials: how many in all, those already in the store included; one whose run could not begin does not count.
    at_once: launched together. startup: random trials before the sampler learns. seed: of the sampler.
    """

    trials: int
    at_once: int = 1
    sampler: str = "tpe"
    startup: int = 5
    seed: int = 0


def propose(
    space: Space,
    objectives: Sequence[str],
    trials: Sequence[Trial],
    count: int,
    options: Options,
    result: Callable[[Point], Hashable] = lambda point: point,
) -> list[Point]:
    """Up to `count` points whose result is that of no trial and no other point; fewer if the space has no more.

    result: equal for points whose runs are the same.

    The same trials in the same order give the same points, so a search that was killed goes on as if it had not been.
    """
    own_seed = int(np.random.SeedSequence([options.seed, len(trials)]).generate_state(1)[0])
    study = rebuilt(space, objectives, trials, SAMPLERS[options.sampler](options.startup, own_seed))
    tried = {result(trial.point) for trial in trials}
    proposed: list[Point] = []
    while len(proposed) < count and (point := _ask(study, space, own_seed, lambda p: result(p) not in tried)):
        tried.add(result(point))
        proposed.append(point)
    return proposed


def rebuilt(
    space: Space, objectives: Sequence[str], trials: Sequence[Trial], sampler: BaseSampler | None = None
) -> optuna.Study:
    """Optuna's study of the trials, in memory."""
    study = optuna.create_study(directions=[goals.direction(name) for name in objectives], sampler=sampler)
    study.add_trials([_frozen(space, trial, len(objectives) == 1) for trial in trials])
    return study


def best(space: Space, objectives: Sequence[str], trials: Sequence[Trial]) -> list[Trial]:
    """The finished trials that no other beats in every objective: of one objective the best, of several the front."""
    if not any(trial.state == "finished" for trial in trials):
        return []
    return [trials[frozen.number] for frozen in rebuilt(space, objectives, trials).best_trials]


def importances(space: Space, objectives: Sequence[str], trials: Sequence[Trial]) -> dict[str, float]:
    """Option -> its share in what makes trials good (PED-ANOVA, arXiv:2304.10255), the largest first.

    Empty for several objectives, for one option, and below 10 finished trials.
    """
    finished = [trial for trial in trials if trial.state == "finished"]
    if len(objectives) > 1 or len(space) < 2 or len(finished) < 10:
        return {}
    return get_param_importances(rebuilt(space, objectives, finished), evaluator=PedAnovaImportanceEvaluator())


def _frozen(space: Space, trial: Trial, one_objective: bool) -> FrozenTrial:
    return create_trial(
        state=_STATES[trial.state],
        params={option: space[option].drawn(text) for option, text in zip(space, trial.point, strict=True)},
        distributions={option: values.distribution() for option, values in space.items()},
        values=list(trial.values) or None,
        intermediate_values=dict(trial.curve) if one_objective else {},
    )


def _ask(study: optuna.Study, space: Space, seed: int, untried: Callable[[Point], bool]) -> Point | None:
    """What Optuna proposes, or a random point if it insists on what was tried; None if there is nothing else."""
    distributions = {option: values.distribution() for option, values in space.items()}
    for attempt in range(REPEATS + DRAWS):
        if attempt == REPEATS:
            study.sampler = RandomSampler(seed)
        trial = study.ask(distributions)
        point = tuple(space[option].text(trial.params[option]) for option in space)
        if untried(point):
            return point
        study.tell(trial, state=TrialState.FAIL)
    return None
