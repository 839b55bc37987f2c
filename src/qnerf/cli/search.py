"""`hydra/sweeper=qnerf_optuna`: the search of `qnerf.search` as a sweeper of Hydra.

The values that a sweep would combine are the space of the search. The trials run through the launcher of the sweep.
"""

import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Interval as Bounds
from annotated_types import MinLen
from hydra.core.override_parser.types import IntervalSweep, Override
from hydra.core.plugins import Plugins
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf

from qnerf.building.configuration import Configuration
from qnerf.building.scene import prepare
from qnerf.cli.ends import FAILED
from qnerf.cli.errors import report
from qnerf.cli.sweep import Composer, Sweep, effective, texts_of
from qnerf.cli.table import Column, metric_column, print_table
from qnerf.cli.text import console
from qnerf.config import bounds
from qnerf.config.bounds import NonNegativeInt, PositiveInt, Seed
from qnerf.metrics import metric_of
from qnerf.search import objectives as goals
from qnerf.search.history import History
from qnerf.search.loop import NoObjective, search
from qnerf.search.pruning import Judge
from qnerf.search.space import Choices, Interval, Point, Space, overrides
from qnerf.search.study import Options, Trial, best, importances
from qnerf.training.forecast import announced

FILE = "judge.json"
"""In the folder of a sweep: what its jobs need to know to judge themselves."""
TRIALS = "trials.json"
"""In the folder of a sweep: what a search has found."""
SHOWN = 10  # trials in the closing table of a search with one objective
UNVALIDATED = (
    "scene.validation: a search looks at validation views, never at test views, and none are held out; "
    "scene.validation=0.1 holds out a tenth of what trains"
)
NO_OTHER_SEED = (
    "seed: this training sees all points, so a search takes a seed of its own, of which tables leave runs out: "
    f"seed={goals.TUNING[0]}"
)
OPTIONS: Mapping[str, Any] = {
    "objectives": Annotated[list[str], MinLen(1)],
    "n_trials": PositiveInt,
    "n_jobs": PositiveInt,
    "seeds": Annotated[list[Seed], MinLen(1)] | None,
    "startup": PositiveInt,
    "seed": Annotated[int, Bounds(ge=0, le=2**32 - 1)],
    "prune.percentile": Annotated[float, Bounds(ge=0, le=100)],
    "prune.least": PositiveInt,
    "prune.warmup": NonNegativeInt,
}


def judge(sweep: Path, store: Path) -> Judge | None:
    """What a job judges itself by; None if no job of the sweep is given up."""
    path = sweep / FILE
    return Judge(store, **json.loads(path.read_text())) if path.exists() else None


class OptunaSweeper(Sweeper):
    """See conf/hydra/sweeper/qnerf_optuna.yaml for the options."""

    config: Any
    hydra_context: Any
    launcher: Any

    def __init__(self, params: Mapping[str, Any] | None = None, **options: Any) -> None:
        self.params = params or {}
        self.options: Any = OmegaConf.to_container(OmegaConf.create(options))
        self.jobs = 0

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        self.config, self.hydra_context = config, hydra_context
        self.launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments: list[str]) -> None:
        for name, hint in OPTIONS.items():
            group, _, last = name.rpartition(".")
            bounds.check(f"hydra.sweeper.{name}", (self.options[group] if group else self.options)[last], hint)
        goals.check(self.options["objectives"])
        typed = [*(f"{key}={value}" for key, value in self.params.items()), *arguments]
        composer = Composer(self.hydra_context.config_loader, self.config)
        parsed = effective(composer.parser.parse_overrides(typed))
        swept = {item.get_key_element(): item for item in parsed if item.is_sweep_override()}
        if not swept:
            raise ValueError("a search needs a space: an option with several values, such as qiren.layers=1,2,3")
        if twice := [item for item in parsed if item.get_key_element() in swept and item not in swept.values()]:
            raise ValueError(f"{twice[0].input_line}: a search varies this option, which is given twice; give it once")
        space = {key: values_of(item) for key, item in swept.items()}
        fixed = [text for item in parsed if not item.is_sweep_override() for text in texts_of(item)]
        try:
            trials = self._search(space, fixed, composer)
        except NoObjective as error:
            report(ValueError(error))
            sys.exit(FAILED)
        show(space, self.options["objectives"], trials)
        found = [{"overrides": overrides(space, one.point), **asdict(one)} for one in trials]
        (Path(self.config.hydra.sweep.dir) / TRIALS).write_text(json.dumps(found))
        if trials and not any(trial.state in ("finished", "pruned") for trial in trials):
            sys.exit(FAILED)

    def _search(self, space: Space, fixed: list[str], composer: Composer) -> list[Trial]:
        options, store = self.options, Path(self.config.store)
        sweep = Sweep(self.config.hydra.sweep.dir)
        sweep.folder.mkdir(parents=True, exist_ok=True)
        OmegaConf.save(self.config, sweep.folder / "multirun.yaml")
        seeds = [[f"seed={seed}"] for seed in options["seeds"] or ()] or [[]]
        judged = goals.judged(options["objectives"])
        metric = judged if len(options["objectives"]) == 1 else None
        scenes: dict[str, Any] = {}

        def ids(point: Point) -> list[str]:
            found = []
            for seed in seeds:
                own = Configuration.of(composer.configuration([*fixed, *overrides(space, point), *seed]))
                scene = json.dumps(own.complete["scene"], sort_keys=True)
                prepared = prepare(own, scenes.get(scene))
                scenes.setdefault(scene, prepared.source)
                if judged and prepared.task.tests_unseen and not own["scene.validation"]:
                    raise NoObjective(UNVALIDATED)
                if judged and not prepared.task.tests_unseen and own["seed"] not in goals.TUNING:
                    raise NoObjective(NO_OTHER_SEED)
                found.append(prepared.find_id(store))
            return found

        def launch(points: Sequence[Point], trials: Sequence[Trial]) -> None:
            if options["prune"]["percentile"] and metric:
                peers = [name for trial in trials if trial.state == "finished" for name in trial.runs]
                (sweep.folder / FILE).write_text(json.dumps({"metric": metric, "peers": peers, **options["prune"]}))
            jobs = [[*fixed, *overrides(space, point), *seed] for point in points for seed in seeds]
            begun = time.monotonic()
            for job in self.launcher.launch(jobs, initial_job_idx=self.jobs):
                _ = job.return_value  # raises what a job has raised
            left = min(options["n_trials"], size(space)) - len(trials) - len(points)
            if not self.jobs and left > 0:
                seconds = (time.monotonic() - begun) / len(points) * left
                hours = composer.configuration(jobs[0])["run"]["hours"]
                if line := announced(f"{left} trials more", seconds, hours, "hydra.sweeper.n_trials takes fewer"):
                    print(line, flush=True)
            self.jobs += len(jobs)

        history = History(space, options["objectives"], store, ids, self._defaults(space))
        plan = Options(options["n_trials"], options["n_jobs"], options["sampler"], options["startup"], options["seed"])
        trials = search(history, plan, launch)
        for point, reason in history.rejected.items():
            if reason:
                sweep.fail(self.jobs, [*fixed, *overrides(space, point)], reason)
                self.jobs += 1
        return trials

    def _defaults(self, space: Space) -> dict[str, str]:
        """Option -> its value in a run whose command does not name it."""
        choices = self.config.hydra.runtime.choices
        return {option: str(choices.get(option, OmegaConf.select(self.config, option))) for option in space}


def values_of(override: Override) -> Choices | Interval:
    """The values of an option that is swept.

    Raises:
        ValueError: an empty list, or an interval whose first number is not the smaller one.
    """
    swept = override.value()
    if isinstance(swept, IntervalSweep):
        low, high = swept.start, swept.end
        log, integer = "log" in swept.tags, "int" in swept.tags or (isinstance(low, int) and isinstance(high, int))
        if low is None or high is None or not low <= high or (log and low <= 0):
            raise ValueError(f"{override.input_line}: expected two numbers, the smaller one first" + ", above 0" * log)
        return Interval(int(low) if integer else low, int(high) if integer else high, log, integer)
    texts = list(override.sweep_string_iterator())
    if not texts:
        raise ValueError(f"{override.input_line}: an empty list of values")
    return Choices.of(texts)


def size(space: Space) -> float:
    """How many points there are; infinite where an option has an interval."""
    return math.prod(len(own.texts) if isinstance(own, Choices) else math.inf for own in space.values())


def show(space: Space, objectives: Sequence[str], trials: Sequence[Trial]) -> None:
    """Prints the best trials, or the Pareto front of several objectives."""
    if len(objectives) == 1:
        finished = [trial for trial in trials if trial.state == "finished"]
        upwards = goals.direction(objectives[0]) == "maximize"
        listed = sorted(finished, key=lambda trial: trial.values[0], reverse=upwards)[:SHOWN]
        title = f"best {len(listed)} of {len(trials)} trials"
    else:
        listed = sorted(best(space, objectives, trials), key=lambda trial: trial.values)
        title = f"Pareto front: {len(listed)} of {len(trials)} trials"
    states = [trial.state for trial in trials]
    counts = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states))
    print(f"\n{title} ({counts})" if trials else "\nno trials")
    columns = [
        Column("trial", lambda row: row["trial"], limit=255),
        *(metric_column(metric_of(name)) for name in objectives),
        Column("runs", lambda row: row["runs"], rank=1, limit=255),
    ]
    rows = [
        {"trial": " ".join(overrides(space, trial.point)), "runs": ",".join(trial.runs)}
        | dict(zip(objectives, trial.values, strict=True))
        for trial in listed
    ]
    if rows:
        print_table(console(), columns, rows)
    if shares := importances(space, objectives, trials):
        print("what mattered: " + ", ".join(f"{option} {share:.0%}" for option, share in shares.items()))
