"""Hydra's side: composes the configuration from conf/ and the command line, and hands each job to the library.

The jobs of a sweep run one after the other, or wherever `hydra/launcher=...` puts them (`sweep.py`).
"""

import contextlib
import logging
import os
import re
import sys
import traceback
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console
from rich.table import Table
from rich.text import Text

from qnerf.building.configuration import Configuration
from qnerf.cli import compose, ends, plugins
from qnerf.cli import sweep as sweeps
from qnerf.cli.ends import FAILED, INTERRUPTED
from qnerf.cli.errors import is_known, one_line, report
from qnerf.cli.resolvers import MAIN
from qnerf.cli.sweep import Sweep
from qnerf.config.folders import CONF
from qnerf.records import owner, state

# The plugins' schemas have the names of the files in conf/hydra/launcher. Hydra warns that matching them is deprecated.
warnings.filterwarnings("ignore", message=r"\s*'hydra/launcher/\w+' is validated against ConfigStore schema")

_jobs: list[Sweep | None] = []  # of the jobs that began in this process, the sweep
_beside: "list[Launched] | None" = None  # of a launcher that trains jobs side by side, those that it has begun
_full_errors: list[bool] = []  # whether the user asked for tracebacks, with Hydra's HYDRA_FULL_ERROR=1


@dataclass
class Launched:
    """One run, or a job of a sweep: its number there, and what the user typed."""

    sweep: Sweep | None
    number: int
    overrides: list[str] = field(default_factory=list)
    console: Console = field(default_factory=Console)
    configuration: Any = None
    display: Any = None


@ends.stoppable()  # the processes of a launcher start here
def job(composed: DictConfig) -> None:
    """One job of a run or a sweep: hands Hydra's configuration to the library and prints an error as one line."""
    from qnerf.cli.training import train

    ends.escape_unencodable()  # in a launcher's process, too
    own = HydraConfig.get()
    multirun = own.mode == RunMode.MULTIRUN
    one = Launched(Sweep(own.sweep.dir) if multirun else None, own.job.num if multirun else 0)
    _jobs.append(one.sweep)
    try:
        if ends.output_lost():
            sys.exit(ends.stopped_code())
        _begin(one, composed)
        if _beside is not None:
            _beside.append(one)
        else:
            _end(one, train(one.configuration, one.overrides, one.display))
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        sys.exit(ends.stopped_code())
    except Exception as error:
        _failed(error, one)


@contextlib.contextmanager
def together() -> Iterator[None]:
    """Jobs that begin inside wait for its end, and then train side by side."""
    global _beside
    jobs: list[Launched] = []
    _beside = jobs
    try:
        yield
    finally:
        _beside = None
    _train_beside(jobs)


@ends.stoppable()
def _train_beside(jobs: Sequence[Launched]) -> None:
    from qnerf.cli.training import train_beside

    for number, outcome in train_beside([(one.configuration, one.overrides, one.display) for one in jobs]):
        if isinstance(outcome, Exception):
            _failed(outcome, jobs[number])
        else:
            _end(jobs[number], outcome)


def _failed(error: Exception, one: Launched) -> None:
    """Prints the error as one line. A bug keeps its traceback, and so does everything with HYDRA_FULL_ERROR=1."""
    from qnerf.training.trainer import Diverged

    known = is_known(error) or isinstance(error, (Diverged, OmegaConfBaseException))
    if any(_full_errors) or (one.sweep is None and not known):
        raise error
    if not known:
        traceback.print_exception(error)
    code = report(error)
    if one.sweep is None:
        sys.exit(code if isinstance(error, (ValueError, OmegaConfBaseException)) else FAILED)
    reason = one_line(error) if known else f"{type(error).__name__}: {one_line(error)}"
    one.sweep.fail(one.number, one.overrides, reason)


def _begin(one: Launched, composed: DictConfig) -> None:
    """Composes the job's configuration, and says which job it is."""
    from qnerf.cli.display import LiveDisplay
    from qnerf.cli.training import note_without_effect

    one.overrides = list(HydraConfig.get().overrides.task)
    plugins.load(list(composed.plugins))  # a launcher's process has not; what is resolved depends on their classes
    config: dict[str, Any] = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)  # type: ignore[assignment]
    _show_warnings()
    if one.sweep is not None and one.console.is_terminal:
        one.console.rule(" ".join(one.overrides), align="left")
    elif one.sweep is not None:
        one.console.print(" ".join(one.overrides), highlight=False, markup=False, soft_wrap=True)
    one.configuration = Configuration.of(config)
    # A sweep has said so in its first line.
    changed = None if one.sweep else note_without_effect(one.configuration, one.overrides)
    beside = _beside[0].display if _beside else None
    label = "" if _beside is None else sweeps.started[-1].own(one.overrides)
    judge = _judge(one.sweep, config["store"])
    one.display = LiveDisplay(one.console, config["run"]["progress"], changed, judge, label, beside)


def _end(one: Launched, outcome: Any) -> None:
    from qnerf.cli.display import print_outcome

    if one.display.label:
        one.console.print(one.display.label, highlight=False, markup=False, soft_wrap=True)
    print_outcome(one.console, outcome, brief=one.sweep is not None)
    if outcome.state == "busy" and one.sweep is not None:
        one.sweep.busy(one.number, one.overrides, outcome.path)
    elif outcome.state == "busy":
        sys.exit(FAILED)
    elif outcome.state == "interrupted":
        sys.exit(ends.stopped_code())


def _show_warnings() -> None:
    """Warnings of the library go to standard error. Hydra has turned them off."""
    log = logging.getLogger("qnerf")
    log.disabled = False
    log.setLevel(logging.WARNING)


def _judge(sweep: Sweep | None, store: str) -> Any:
    """What a job of a search gives up by; None: any other run is never given up."""
    if sweep is not None and HydraConfig.get().runtime.choices["hydra/sweeper"] == "qnerf_optuna":
        from qnerf.cli.search import judge

        return judge(sweep.folder, Path(store))
    return None


def show(composed: DictConfig) -> None:
    """`--cfg job`: the configuration that acts, or as far as it is composed where options are missing."""
    try:
        config: Any = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)
        shown: Any = Configuration.of(config).complete
    except (ValueError, OmegaConfBaseException) as error:
        print(f"note: not complete: {one_line(error)}", file=sys.stderr)
        shown = composed
    print(OmegaConf.to_yaml(shown), end="")


def _report(sweep: Sweep) -> int:
    """Prints which jobs of a sweep failed and why, and what others still train; returns the exit code."""
    failures = sweep.failures()
    if failures:
        table = Table("job", "reason", title=f"{len(failures)} failed")
        for overrides, reason in failures:
            table.add_row(Text(overrides), Text(reason))
        Console(stderr=True).print(table)
    if busy := [run for run in sweep.busy_runs() if state(run) != "finished"]:
        names = ", ".join(f"{run.name} ({owner.describe(run)})" for run in busy)
        print(f"not finished, other processes train them: {names}; the same command looks again", file=sys.stderr)
    return FAILED if failures or busy else 0


def run_command() -> None:
    """Composes the configuration from conf/ and the command line, and runs it."""
    _full_errors[:] = [os.environ.get("HYDRA_FULL_ERROR", "0") not in ("", "0")]
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises errors instead of printing them itself
    code: Any = 0
    task = job
    try:
        sys.argv[1:], options = compose.arguments_for_hydra(compose.expand_sweep(sys.argv[1:]))
        plugins.load(compose.plugins(sys.argv[1:]))
        if options["cfg"] == "job" and not options["package"] and not options["resolve"]:
            task = show
            sys.argv[1:] = [*_without_cfg(sys.argv[1:]), "hydra.mode=RUN"]
        hydra.main(config_path=str(CONF), config_name="config", **MAIN)(task)()
    except SystemExit as end:
        code = end.code
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        code = INTERRUPTED
    except Exception as error:
        if any(_full_errors) or (_jobs and not sweeps.started):  # a job prints a user's mistake itself: this is a bug
            raise
        code = _not_launched(error)
    reported = [_report(sweep) for sweep in sweeps.started]
    if code or any(reported):
        sys.exit(code or max(reported))


def _without_cfg(arguments: list[str]) -> list[str]:
    place = next(i for i, argument in enumerate(arguments) if re.match("--?c(fg)?(=|$)", argument))
    return arguments[:place] + arguments[place + (1 if "=" in arguments[place] else 2) :]


def _not_launched(error: Exception) -> int:
    """Prints why Hydra could not compose a configuration or a launcher ended early; returns the exit code."""
    if isinstance(error, HydraException):
        return report(ValueError(compose.message(error, sys.argv[1:])))
    if _jobs or "Worker" in type(error).__name__ or any(any((one.folder / "jobs").glob("*")) for one in sweeps.started):
        # The launcher failed: a process was killed for lack of memory, or a job of a queue was.
        print(f"error: the sweep ended early; the same command continues it: {one_line(error)}", file=sys.stderr)
        return FAILED
    known = isinstance(error, (ValueError, OSError, OmegaConfBaseException))
    return report(error if known else ValueError(f"nothing was begun: {one_line(error)}"))
