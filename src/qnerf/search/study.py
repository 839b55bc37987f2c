"""Trials, and Optuna's study of them: what to try next is a function of the trials so far."""

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import optuna
from optuna.distributions import BaseDistribution
from optuna.samplers import BaseSampler, GPSampler, RandomSampler, TPESampler
from optuna.trial import FrozenTrial, TrialState, create_trial

from qnerf.search import objectives as goals
from qnerf.search.space import Point, Space, points, random_point, size

REPEATS = 20  # proposals of what was tried already, after which a point that was not is drawn at random
COUNTABLE = 10**5  # points of a space that are listed to find those that were not tried
DRAWS = 1000  # from a larger space

SAMPLERS = {
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


def propose(
    space: Space,
    objectives: Sequence[str],
    trials: Sequence[Trial],
    count: int,
    *,
    sampler: str = "tpe",
    startup: int = 5,
    seed: int = 0,
    alike: Callable[[Point], Hashable] = lambda point: point,
) -> list[Point]:
    """Up to `count` points that are like no trial's and no other's; fewer only if the space has no more.

    alike: points for which it is equal are one.

    The same trials in the same order give the same points, so a search that was killed goes on as if it had not been.
    """
    seeds = np.random.SeedSequence([seed, len(trials)])
    study = rebuilt(space, objectives, trials, SAMPLERS[sampler](startup, int(seeds.generate_state(1)[0])))
    distributions = {option: values.distribution() for option, values in space.items()}
    rng = np.random.default_rng(seeds)
    tried = {alike(trial.point) for trial in trials}

    def untried(point: Point) -> bool:
        return alike(point) not in tried

    proposed: list[Point] = []
    for _ in range(count):
        point = _ask(study, space, distributions, untried) or _drawn(space, untried, rng)
        if point is None:
            break
        tried.add(alike(point))
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


def _frozen(space: Space, trial: Trial, one_objective: bool) -> FrozenTrial:
    return create_trial(
        state=_STATES[trial.state],
        params={option: space[option].drawn(text) for option, text in zip(space, trial.point, strict=True)},
        distributions={option: values.distribution() for option, values in space.items()},
        values=list(trial.values) or None,
        intermediate_values=dict(trial.curve) if one_objective else {},
    )


def _ask(
    study: optuna.Study,
    space: Space,
    distributions: Mapping[str, BaseDistribution],
    untried: Callable[[Point], bool],
) -> Point | None:
    """What Optuna proposes; None if it insists on what was tried."""
    for _ in range(REPEATS):
        trial = study.ask(dict(distributions))
        point = tuple(space[option].text(trial.params[option]) for option in space)
        if untried(point):
            return point
        study.tell(trial, state=TrialState.FAIL)
    return None


def _drawn(space: Space, untried: Callable[[Point], bool], rng: np.random.Generator) -> Point | None:
    if size(space) <= COUNTABLE:
        listed = list(points(space))
        drawn = (listed[place] for place in rng.permutation(len(listed)))
    else:
        drawn = (random_point(space, rng) for _ in range(DRAWS))
    return next(filter(untried, drawn), None)
