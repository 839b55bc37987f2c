"""`hydra/sweeper=qnerf_optuna`: the search of `qnerf.search` as a sweeper of Hydra.

The values that a sweep would combine are the space of the search. The trials run through the launcher of the sweep.
"""

import contextlib
import copy
import importlib
import json
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Interval as Bounds
from annotated_types import MinLen
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import IntervalSweep, Override
from hydra.core.plugins import Plugins
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from qnerf.building.acting import decisive
from qnerf.building.components import component
from qnerf.building.scene import prepare
from qnerf.cli.errors import report
from qnerf.cli.sweep import Sweep
from qnerf.cli.table import Column, metric_column, print_table
from qnerf.cli.text import console
from qnerf.config import bounds
from qnerf.config.bounds import NonNegativeInt, PositiveInt, Seed
from qnerf.config.checks import is_number
from qnerf.metrics import HEAD_PARAMETERS, metric_of
from qnerf.records.files import one_line, replace
from qnerf.scenes import SCENES
from qnerf.search import objectives as goals
from qnerf.search.history import History
from qnerf.search.loop import Options, search
from qnerf.search.pruning import Judge
from qnerf.search.space import Choices, Interval, Point, Space, overrides
from qnerf.search.study import Trial, best

TARGET = "hydra_plugins.qnerf_optuna.OptunaSweeper"
FILE = "judge.json"
"""In the folder of a sweep: what its jobs need to know to judge themselves."""

SHOWN = 10  # trials in the closing table of a search with one objective


def register() -> None:
    """Puts the sweeper where Hydra keeps the plugins that it has found, all of the package `hydra_plugins`."""
    Plugins.instance().class_name_to_class[TARGET] = OptunaSweeper


def judge(sweep: Path, store: Path) -> Judge | None:
    """What a job judges itself by; None if the sweep is no search."""
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
        try:
            self._check_options()
            typed = [*(f"{key}={value}" for key, value in self.params.items()), *arguments]
            parsed = OverridesParser.create(config_loader=self.hydra_context.config_loader).parse_overrides(typed)
            swept = {item.get_key_element(): item for item in parsed if item.is_sweep_override()}
            space = {key: values_of(item, self._is_group(item)) for key, item in swept.items()}
            if not space:
                raise ValueError("a search needs a space: an option with several values, such as qiren.layers=1,2,3")
            fixed = [
                f"{item.get_key_element()}={item.get_value_element_as_str()}"
                for item in parsed
                if item.get_key_element() not in swept
            ]
            choices = self.config.hydra.runtime.choices
            groups = {key: str(choices.get(key)) for key, item in swept.items() if self._is_group(item)}
            self._search(space, fixed, groups)
        except ValueError as error:
            sys.exit(report(error))

    def _check_options(self) -> None:
        known = {
            "objectives": Annotated[list[str], MinLen(1)],
            "n_trials": PositiveInt,
            "n_jobs": PositiveInt | None,
            "seeds": Annotated[list[Seed], MinLen(1)] | None,
            "startup": PositiveInt,
            "seed": Annotated[int, Bounds(ge=0, le=2**32 - 1)],
        }
        for name, hint in known.items():
            bounds.check(f"hydra.sweeper.{name}", self.options[name], hint)
        prune = {"percentile": Annotated[float, Bounds(ge=0, le=100)], "least": PositiveInt, "warmup": NonNegativeInt}
        for name, hint in prune.items():
            bounds.check(f"hydra.sweeper.prune.{name}", self.options["prune"][name], hint)
        goals.check(self.options["objectives"])

    def _is_group(self, override: Override) -> bool:
        return bool(self.hydra_context.config_loader.get_group_options(override.key_or_group))

    def _search(self, space: Space, fixed: list[str], groups: Mapping[str, str]) -> None:
        options, store = self.options, Path(self.config.store)
        sweep = Sweep(self.config.hydra.sweep.dir)
        sweep.folder.mkdir(parents=True, exist_ok=True)
        OmegaConf.save(self.config, sweep.folder / "multirun.yaml")
        seeds = [[f"seed={seed}"] for seed in options["seeds"] or ()] or [[]]
        configurations = _Configurations(self.hydra_context, self.config, fixed, groups)

        def ids(point: Point) -> list[str]:
            return [configurations.run_id([*overrides(space, point), *seed]) for seed in seeds]

        def launch(points: Sequence[Point], trials: Sequence[Trial]) -> None:
            prune = options["prune"]
            if prune["percentile"]:
                peers = [name for trial in trials if trial.state == "finished" for name in trial.runs]
                content = {"objectives": options["objectives"], "peers": peers, **prune}
                replace(sweep.folder / FILE, json.dumps(content).encode())
            jobs = [[*overrides(space, point), *fixed, *seed] for point in points for seed in seeds]
            for job in self.launcher.launch(jobs, initial_job_idx=self.jobs):
                _ = job.return_value  # raises what a job has raised
            self.jobs += len(jobs)

        def alike(point: Point) -> str:
            return configurations.what_acts(overrides(space, point))

        history = History(space, options["objectives"], store, ids, groups, alike)
        plan = Options(options["n_trials"], self._at_once(), options["sampler"], options["startup"], options["seed"])
        trials = search(history, plan, launch, sweep.stopping)
        for point, reason in history.rejected.items():
            if reason:
                sweep.fail(self.jobs, [*fixed, *overrides(space, point)], reason)
                self.jobs += 1
        show(space, options["objectives"], trials)
        for path in draw(options["objectives"], trials, store, sweep.folder):
            print(path)

    def _at_once(self) -> int:
        wanted = self.options["n_jobs"] or self.config.hydra.launcher.get("n_jobs") or 1
        return int(wanted) if wanted > 0 else os.cpu_count() or 1


class _Configurations:
    """Configurations of trials. Hydra composes one for each choice of groups, which takes a fifth of a second; options
    are then set as Hydra would."""

    def __init__(
        self, context: HydraContext, config: DictConfig, fixed: Sequence[str], groups: Mapping[str, str]
    ) -> None:
        self.context, self.config, self.fixed, self.groups = context, config, list(fixed), groups
        self.parser = OverridesParser.create()
        self.composed: dict[tuple[str, ...], DictConfig] = {}
        self.scenes: dict[str, Any] = {}

    def run_id(self, own: Sequence[str]) -> str:
        """The run of these overrides. ValueError if the configuration is not valid."""
        plain = self._resolved(own)
        scene = json.dumps(plain["scene"], sort_keys=True)
        if scene not in self.scenes:
            self.scenes[scene] = component(SCENES, plain["scene"])
        return prepare(plain, self.scenes[scene]).find_id(plain["store"])

    def what_acts(self, own: Sequence[str]) -> str:
        """Equal for overrides whose runs would give the same result."""
        try:
            return json.dumps(decisive(self._resolved(own)), sort_keys=True)
        except ValueError:
            return json.dumps(own)

    def _resolved(self, own: Sequence[str]) -> dict[str, Any]:
        chosen = tuple(item for item in own if item.partition("=")[0] in self.groups)
        if chosen not in self.composed:
            composed = self.context.config_loader.load_sweep_config(self.config, [*self.fixed, *chosen])
            with open_dict(composed):
                del composed["hydra"]
            self.composed[chosen] = composed
        config = copy.deepcopy(self.composed[chosen])
        try:
            for item in own:
                if item not in chosen:
                    parsed = self.parser.parse_override(item)
                    OmegaConf.update(config, parsed.key_or_group, parsed.value())
            plain: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
        except OmegaConfBaseException as error:
            raise ValueError(one_line(error)) from error
        return plain


def values_of(override: Override, group: bool) -> Choices | Interval:
    """The values of an option that is swept.

    Raises:
        ValueError: an empty list, or an interval that is none.
    """
    swept = override.value()
    if isinstance(swept, IntervalSweep):
        low, high = swept.start, swept.end
        log, integer = "log" in swept.tags, "int" in swept.tags or (isinstance(low, int) and isinstance(high, int))
        if low is None or high is None or not low <= high or (log and low <= 0):
            raise ValueError(f"{override.input_line}: expected two numbers, the smaller one first" + ", above 0" * log)
        return Interval(int(low) if integer else low, int(high) if integer else high, log, integer)
    texts = list(dict.fromkeys(override.sweep_string_iterator()))
    if not texts:
        raise ValueError(f"{override.input_line}: an empty list of values")
    if group:
        return Choices(tuple(texts), tuple(texts))
    parser = OverridesParser.create()
    found = {text: parser.parse_override(f"{override.key_or_group}={text}").value() for text in texts}
    same = {float(value) if is_number(value) else json.dumps(value): text for text, value in reversed(found.items())}
    kept = [text for text in texts if text in same.values()]  # of 1 and 1.0, the first one
    return Choices(tuple(kept), tuple(found[text] for text in kept))


def show(space: Space, objectives: Sequence[str], trials: Sequence[Trial]) -> None:
    """Prints the best trials, or the Pareto front of several objectives."""
    out = console()
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
        Column("runs", lambda row: row["runs"], rank=1, min_width=14, tail=13, limit=255),
    ]
    rows = [
        {"trial": " ".join(overrides(space, trial.point)), "runs": ",".join(trial.runs)}
        | dict(zip(objectives, trial.values, strict=True))
        for trial in listed
    ]
    if rows:
        print_table(out, columns, rows)


def draw(objectives: Sequence[str], trials: Sequence[Trial], store: Path, folder: Path) -> list[Path]:
    """A figure of the front for each cost beside the judged objective, `front_<cost>.png`; as many as can be drawn."""
    quality = goals.judged(objectives)
    names = [name for trial in trials if trial.state == "finished" for name in trial.runs]
    if quality is None or len(objectives) == 1 or not names:
        return []
    figures, load = (importlib.import_module(f"qnerf.analysis.{name}") for name in ("figures", "load"))
    frame = load.runs(store)
    frame = frame[frame["run_id"].isin(names)]
    frame = frame.assign(**{"params.heads": frame[list(HEAD_PARAMETERS)].sum(axis=1)})
    written: list[Path] = []
    for cost in objectives:
        if metric_of(cost).kind in ("size", "time"):
            with contextlib.suppress(ValueError):
                figure = figures.speed_vs_error(frame, cost, quality)
                written += figures.save(figure, folder / f"front_{cost}", ["png"])
    return written
