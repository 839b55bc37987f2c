"""Sweeps: the folder through which jobs report, the configurations of jobs, and what happens after the last one.

The folder works for jobs on any machine that shares the store:

<store>/.sweeps/<time>/
  multirun.yaml    the sweep's configuration, written by Hydra
  failed/3.json    job 3: its overrides and why it failed
  busy/3.json      job 3: its overrides, and the run that another process was training
  jobs/            scripts and output of a cluster's jobs
"""

import contextlib
import copy
import itertools
import json
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from qnerf.building.configuration import Configuration
from qnerf.cli import compose
from qnerf.cli.errors import one_line
from qnerf.records import StoreError, owner, state
from qnerf.records.files import read_json, replace

COUNTED = 300  # jobs; composing more of them to count different runs takes longer than it is worth
MAX_JOBS = 100_000  # Hydra lists them all in memory
RETRY = 5.0  # seconds between two looks at runs that other processes train

started: list["Sweep"] = []  # sweeps that this process started
_unwritten: dict[Path, dict[str, Any]] = {}  # what this process could not write into the folder of a sweep


class Sweep:
    """The folder of one sweep, created by the first write. `common`: overrides of the whole sweep."""

    def __init__(self, folder: str | Path, common: Collection[str] = ()) -> None:
        self.folder = Path(folder)
        self.common = set(common)

    def fail(self, job: int, overrides: Sequence[str], reason: str) -> None:
        self._write("failed", job, {"overrides": list(overrides), "reason": reason})

    def busy(self, job: int, overrides: Sequence[str], run: Path) -> None:
        """Another process trains the run of this job."""
        self._write("busy", job, {"overrides": list(overrides), "run": str(run)})

    def failures(self) -> list[tuple[str, str]]:
        """Each failed job's own overrides and the reason, in the order of the jobs."""
        return [(self.own(job["overrides"]), job["reason"]) for job in self._read("failed").values()]

    def busy_runs(self) -> dict[Path, tuple[int, list[str]]]:
        """Run -> job and overrides, of the jobs whose runs another process trained when they began."""
        return {Path(job["run"]): (number, job["overrides"]) for number, job in self._read("busy").items()}

    def not_busy(self, job: int) -> None:
        (self.folder / "busy" / f"{job}.json").unlink(missing_ok=True)

    def _write(self, kind: str, job: int, content: Mapping[str, Any]) -> None:
        path = self.folder / kind / f"{job}.json"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            replace(path, json.dumps(content).encode(), durable=False)
        except (OSError, StoreError):  # the disk is full: the other jobs go on, and this process remembers it
            _unwritten[path] = dict(content)
            with contextlib.suppress(OSError):
                path.touch()

    def _read(self, kind: str) -> dict[int, Any]:
        folder = self.folder / kind
        paths = {int(path.stem): path for path in (*folder.glob("*.json"), *_unwritten) if path.parent == folder}
        return {number: _unwritten.get(paths[number]) or _job(paths[number]) for number in sorted(paths)}

    def own(self, overrides: Sequence[str]) -> str:
        """What tells a job from the others; all that it has if nothing does."""
        return " ".join([item for item in overrides if item not in self.common] or overrides)


def _job(path: Path) -> dict[str, Any]:
    """What a job has reported; that it has reported, where the disk had no room for more."""
    try:
        return read_json(path)
    except (OSError, StoreError):
        return {"overrides": [f"job {path.stem}"], "reason": "the disk had no room for the reason", "run": path.stem}


class Grid(BasicSweeper):
    """Hydra's own sweeper, which also says what it will train, and goes back to runs that other processes had."""

    config: Any
    hydra_context: Any
    launcher: Any

    def __init__(self, params: Mapping[str, str] | None = None) -> None:
        # Not the base's own: Hydra imports its module a second time to look for plugins, and `super` there fails.
        self.max_batch_size, self.params = None, dict(params or {})
        self.overrides, self.batch_index = None, 0

    def sweep(self, arguments: list[str]) -> Any:
        parser = OverridesParser.create(config_loader=self.hydra_context.config_loader)
        jobs = combinations(parser.parse_overrides([*self._parse_config(), *arguments]))
        composer = Composer(self.hydra_context.config_loader, self.config)
        announce(jobs, composer.configuration)
        returned = super().sweep(arguments)
        if "submitit" not in self.config.hydra.runtime.choices["hydra/launcher"]:
            self._go_back(Sweep(self.config.hydra.sweep.dir), len(jobs))
        return returned

    @staticmethod
    def split_arguments(overrides: list[Override], max_batch_size: int | None) -> list[list[list[str]]]:
        """All jobs as one batch. Hydra's own drops the first of two mappings."""
        return [combinations(overrides)]

    def validate_batch_is_legal(self, batch: Sequence[Sequence[str]]) -> None:
        """Nothing: `announce` has composed the jobs."""

    def _go_back(self, sweep: Sweep, number: int) -> None:
        """Trains the runs that other processes had, as soon as these processes are dead; leaves what they finish."""
        told = False
        while busy := sweep.busy_runs():
            jobs = []
            for run, (job, overrides) in busy.items():
                if (now := state(run)) != "running":
                    sweep.not_busy(job)
                    jobs += [overrides] if now != "finished" else []
            if jobs:
                for result in self.launcher.launch(jobs, initial_job_idx=number):
                    _ = result.return_value
                number += len(jobs)
            if waiting := [run for run in sweep.busy_runs() if state(run) == "running"]:
                if not told:
                    names = ", ".join(f"{run.name} ({owner.describe(run)})" for run in waiting)
                    print(f"waiting for runs that other processes train: {names}", flush=True)
                told = True
                time.sleep(RETRY)


def effective(parsed: Sequence[Override]) -> list[Override]:
    """Without what a later override of the same option replaces, as in a single run; a mapping replaces nothing."""
    keys = [override.get_key_element() for override in parsed]
    last = {key: number for number, key in enumerate(keys) if not _is_mapping(parsed[number])}
    return [override for number, override in enumerate(parsed) if number >= last.get(keys[number], 0)]


def texts_of(override: Override) -> list[str]:
    """`OPTION=VALUE` of each value."""
    swept = override.is_sweep_override()
    values = override.sweep_string_iterator() if swept else [override.get_value_element_as_str()]
    return [f"{override.get_key_element()}={value}" for value in values]


def _is_mapping(override: Override) -> bool:
    return isinstance(override.value(), dict) or (override.is_choice_sweep() and "{" in (override.input_line or ""))


def combinations(parsed: Sequence[Override]) -> list[list[str]]:
    """The overrides of each job of a sweep; ValueError as `check_count`."""
    acting = effective(parsed)
    check_count(acting)
    return [list(job) for job in itertools.product(*map(texts_of, acting))]


def check_count(parsed: Sequence[Override]) -> int:
    """The number of jobs of a sweep; ValueError for no job, or for more than `MAX_JOBS`."""
    count = 1
    for override in parsed:
        if override.is_discrete_sweep():
            count *= sum(1 for _, _ in zip(range(MAX_JOBS + 1), override.sweep_string_iterator(), strict=False))
        elif override.is_sweep_override():
            raise ValueError(f"{override.input_line}: an interval needs a search, hydra/sweeper=qnerf_optuna")
        if not 0 < count <= MAX_JOBS:
            reason = f"more than {MAX_JOBS} jobs" if count else "an empty list of values, so there is no job"
            raise ValueError(f"{override.input_line}: {reason}")
    return count


def announce(jobs: Sequence[Sequence[str]], configuration: Callable[[Sequence[str]], Mapping[str, Any]]) -> None:
    """Composes the jobs, and says in one line what they are.

    configuration: the configuration that the overrides of a job give.
    """
    different: set[str] = set()
    vain: dict[str, bool] = {}  # option -> whether it has no effect in any of the jobs
    for overrides in jobs[:COUNTED]:
        config = configuration(overrides)
        try:
            own = Configuration.of(config)
            different.add(json.dumps(own.acting, sort_keys=True))
            without = own.without_effect(overrides)
        except ValueError:  # the job will say so
            different.add(json.dumps(list(overrides)))
            continue
        for override in overrides:
            option = override.partition("=")[0]
            vain[option] = vain.get(option, True) and override in without
    if len(jobs) <= COUNTED:
        print(f"{_count(len(jobs), 'job')}, {_count(len(different), 'different run')}", flush=True)
        if names := [option for option, everywhere in vain.items() if everywhere]:
            print(f"note: no effect in any job: {', '.join(names)}", flush=True)


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'s' * (number != 1)}"


class Composer:
    """Configurations of the jobs of a sweep.

    Hydra composes one for each choice of groups, which takes a fifth of a second. Options are then set as Hydra would.
    """

    def __init__(self, loader: Any, config: DictConfig) -> None:
        self.loader, self.config = loader, config
        self.parser = OverridesParser.create(config_loader=loader)
        self._composed: dict[tuple[str, ...], DictConfig] = {}

    def configuration(self, overrides: Sequence[str]) -> dict[str, Any]:
        """The resolved configuration of a job.

        Raises:
            HydraException: a choice or an option that does not exist.
            ValueError: an option without a value, or an interpolation that leads nowhere.
        """
        parsed = self.parser.parse_overrides(list(overrides))
        plain = [one for one in parsed if one.type.name == "CHANGE" and not self.is_group(one.key_or_group)]
        chosen = tuple(str(one.input_line) for one in parsed if one not in plain)
        if chosen not in self._composed:
            composed = self.loader.load_sweep_config(self.config, list(chosen))
            with open_dict(composed):
                del composed["hydra"]
            self._composed[chosen] = composed
        config = copy.deepcopy(self._composed[chosen])
        try:
            for one in plain:
                try:
                    OmegaConf.update(config, one.key_or_group, one.value(), merge=True)
                except (ConfigAttributeError, ConfigKeyError) as error:
                    raise ValueError(compose.unknown_option(one.key_or_group, config)) from error
            resolved: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
        except OmegaConfBaseException as error:
            raise ValueError(one_line(error)) from error
        return resolved

    def is_group(self, key: str) -> bool:
        return bool(self.loader.get_group_options(key))
