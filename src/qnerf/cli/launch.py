"""Hydra's side: composes the configuration from conf/ and the command line, and hands each job to the library.

The jobs of a sweep run one after the other, or wherever `hydra/launcher=...` puts them. They report to the process that
started the sweep through the sweep's folder.
"""

import contextlib
import importlib.util
import logging
import os
import re
import signal
import sys
import threading
import time
import traceback
import warnings
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, TextIO

import hydra
from annotated_types import MinLen
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console
from rich.table import Table
from rich.text import Text

from qnerf.cli import ends, plugins, resolvers  # noqa: F401  the configuration needs the resolvers
from qnerf.cli import overrides as typed
from qnerf.cli.ends import INTERRUPTED
from qnerf.cli.errors import is_shortage, one_line, report
from qnerf.cli.streams import escape_unencodable
from qnerf.cli.sweep import Sweep, check_file
from qnerf.config import bounds
from qnerf.config.bounds import PositiveInt
from qnerf.config.folders import CONF
from qnerf.config.plugins import raised_in

LAUNCHERS = {
    "joblib": ("hydra_plugins.hydra_joblib_launcher", "parallel"),
    "submitit_local": ("hydra_plugins.hydra_submitit_launcher", "slurm"),
    "submitit_slurm": ("hydra_plugins.hydra_submitit_launcher", "slurm"),
}
"""Launcher -> the module of its plugin, and the extra that installs it."""

SEARCH = "qnerf_optuna"
"""The sweeper that searches instead of training every combination."""

STARTER = "QNERF_SWEEP_PID"  # environment variable: id of the process that started parallel jobs, their parent
RETRY = 10.0  # seconds between attempts to take over the run of a dead job
MAX_JOBS = 100_000  # in a sweep; Hydra lists them all in memory
PATIENCE = 300.0  # seconds of attempts; longer than HEARTBEAT_LIMIT and the watch of `qnerf.records.owner`

# The plugins' schemas have the names of the files in conf/hydra/launcher. Hydra warns that matching them is deprecated.
warnings.filterwarnings("ignore", message=r"\s*'hydra/launcher/\w+' is validated against ConfigStore schema")

_started: list[Sweep] = []  # sweeps that this process started
_jobs: list[Sweep | None] = []  # of the jobs that began in this process, the sweep


class SweepStart(Callback):
    """Prepares a sweep, once, in the process that starts it."""

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        launcher = config.hydra.runtime.choices["hydra/launcher"]
        _require(launcher)
        searches = config.hydra.runtime.choices["hydra/sweeper"] == SEARCH
        if searches:
            _require_search()
        try:
            bounds.check("store", config.store, Annotated[str, MinLen(1)])  # the sweep's folder is inside
            _limit_processes(config, 1 if searches else _count_jobs(config))
        except (ValueError, HydraException, OmegaConfBaseException) as error:
            sys.exit(report(error))  # Hydra would only warn
        sweep = Sweep(Path(config.hydra.sweep.dir).absolute(), config.hydra.overrides.task)
        _started.append(sweep)
        # Jobs compose their configuration again from these overrides and must use this folder, not one of their own.
        quoted = str(sweep.folder).replace("'", "\\'")
        with open_dict(config):
            config.hydra.sweep.dir = str(sweep.folder)
            config.hydra.overrides.hydra.append(f"hydra.sweep.dir='{quoted}'")
        if launcher == "joblib":
            os.environ[STARTER] = str(os.getpid())
            _stop_together(sweep)
        elif launcher == "submitit_slurm":
            print(f"jobs go to Slurm, output is in {sweep.folder / 'jobs'}; Ctrl-C does not stop the jobs", flush=True)


def _limit_processes(config: DictConfig, jobs: int) -> None:
    """At most one process a job or a processor: joblib starts as many as it is told, also with nothing to do.

    Raises:
        ValueError: a number of processes or of jobs at a time that is none.
    """
    bounds.check("hydra.sweeper.max_batch_size", config.hydra.sweeper.get("max_batch_size"), PositiveInt | None)
    launcher = config.hydra.launcher
    wanted = launcher.get("n_jobs")
    if wanted == 0:
        raise ValueError("hydra.launcher.n_jobs must be at least 1, or -1 for one process a usable core, got 0")
    if isinstance(wanted, int):
        launcher.n_jobs = min(wanted, max(jobs, os.cpu_count() or 1))


def _count_jobs(config: DictConfig) -> int:
    """The sweep's number of jobs. ValueError if it has none or over `MAX_JOBS`, or a choice that does not exist."""
    loader = GlobalHydra.instance().config_loader()
    params = config.hydra.sweeper.get("params") or {}
    arguments = [*config.hydra.overrides.task, *(f"{key}={value}" for key, value in params.items())]
    jobs = 1
    for override in OverridesParser.create(loader).parse_overrides(arguments):
        if override.is_sweep_override() and override.is_discrete_sweep():
            values = list(islice(override.sweep_string_iterator(), MAX_JOBS + 1))
            if not values:
                raise ValueError(f"{override.input_line}: an empty list of values, so there is no job")
            jobs *= len(values)
            known = loader.get_group_options(override.key_or_group, ObjectType.CONFIG)
            names = [value for value in values if re.fullmatch(r"[\w.-]+", value) and value != "null"]
            if known and (unknown := [name for name in names if name.removesuffix(".yaml") not in known]):
                raise ValueError(f"{override.key_or_group}={unknown[0]}: unknown; known: {', '.join(known)}")
    if jobs > MAX_JOBS:
        raise ValueError(f"the sweep has more than {MAX_JOBS} jobs")
    return jobs


def _require(launcher: str) -> None:
    if launcher not in LAUNCHERS:
        return
    module, extra = LAUNCHERS[launcher]
    if importlib.util.find_spec("hydra_plugins") is None or importlib.util.find_spec(module) is None:
        print(f'error: hydra/launcher={launcher} needs a plugin: pip install "qnerf[{extra}]"', file=sys.stderr)
        sys.exit(2)


def _require_search() -> None:
    if importlib.util.find_spec("optuna") is None:
        print(f'error: hydra/sweeper={SEARCH} needs Optuna: pip install "qnerf[search]"', file=sys.stderr)
        sys.exit(2)
    from qnerf.cli import search

    search.register()


def _stop_together(sweep: Sweep) -> None:
    """Turns Ctrl-C, SIGTERM and SIGHUP into the stop file that joblib's processes watch.

    A second Ctrl-C or SIGTERM ends this process. A terminal that closes may send SIGHUP more than once.

    Otherwise joblib would kill its processes, and Ctrl-C in a terminal would interrupt them anywhere. They inherit the
    blocked signals of this thread, so another thread has to receive them.
    """
    if not hasattr(signal, "pthread_sigmask"):
        return
    requests = {signal.SIGINT, signal.SIGTERM}
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        requests.add(signal.SIGHUP)
    received: list[int] = []

    def stop(number: int, _frame: Any) -> None:
        if number != signal.SIGHUP:
            if received:
                os._exit(ends.INTERRUPTED)
            received.append(number)
        sweep.stop()

    def receive() -> None:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, requests)
        threading.Event().wait()

    for kind in requests:
        signal.signal(kind, stop)
    signal.pthread_sigmask(signal.SIG_BLOCK, requests)
    threading.Thread(target=receive, name="qnerf-signals", daemon=True).start()


class _Prefixed:
    """Writes to `file` with `prefix` before every line, so that readers can tell the lines of parallel jobs apart."""

    def __init__(self, file: TextIO, prefix: str) -> None:
        self.file = file
        self.prefix = prefix

    def write(self, text: str) -> None:
        self.file.write("".join(self.prefix + line for line in text.splitlines(keepends=True)))

    def flush(self) -> None:
        self.file.flush()


@ends.stoppable()  # the processes of a launcher start here
def job(composed: DictConfig) -> None:
    """One job of a run or a sweep: hands Hydra's configuration to the library and prints an error as one line."""
    escape_unencodable()  # in a launcher's process, too
    hydra_config = HydraConfig.get()
    sweep = Sweep(hydra_config.sweep.dir) if hydra_config.mode == RunMode.MULTIRUN else None
    _jobs.append(sweep)
    side_by_side = sweep is not None and hydra_config.runtime.choices["hydra/launcher"] == "joblib"
    prefix = f"{hydra_config.job.num} | " if side_by_side else ""
    try:
        if not _stopping(sweep):
            _train(composed, prefix, sweep)
    except KeyboardInterrupt:
        print("stopped; the same command continues from the last checkpoint", file=sys.stderr)
        sys.exit(ends.stopped_code())
    except Exception as error:
        known = _is_known(error)
        if _wants_traceback(composed) or (sweep is None and not known):
            raise
        reason = one_line(error)
        if not known:
            traceback.print_exc()
            reason = f"{type(error).__name__}: {reason}"
        print(f"{prefix}error: {reason}", file=sys.stderr)
        if sweep is None:
            sys.exit(2)
        sweep.fail(hydra_config.job.num, list(hydra_config.overrides.task), reason)
    finally:
        if sweep is not None and _is_abandoned():
            os._exit(1)  # otherwise joblib's process waits for its next job


def _wants_traceback(composed: DictConfig) -> bool:
    with contextlib.suppress(OmegaConfBaseException):
        return bool(OmegaConf.select(composed, "run.debug") is True)
    return False


def _stopping(sweep: Sweep | None) -> bool:
    if ends.output_lost():
        if sweep is not None:
            with contextlib.suppress(OSError):
                sweep.stop()  # the other jobs, too
        return True
    return sweep is not None and (sweep.stopping() or _is_abandoned())


def _is_abandoned() -> bool:
    """Whether this is one of joblib's processes and the process that started the sweep is dead."""
    starter = os.environ.get(STARTER, "")
    return starter.isdecimal() and os.getpid() != int(starter) != os.getppid()


def _train(composed: DictConfig, prefix: str, sweep: Sweep | None) -> None:
    from qnerf.building.acting import complete, without_effect
    from qnerf.cli.display import LiveDisplay, print_outcome
    from qnerf.cli.text import tree
    from qnerf.experiment import run

    config: dict[str, Any] = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)  # type: ignore[assignment]
    overrides = list(HydraConfig.get().overrides.task)
    plugins.load(config["plugins"])  # a launcher's process has not imported them
    idle = without_effect(config, overrides)
    config = complete(config)
    log = logging.getLogger("qnerf")  # Hydra has turned it off; its warnings go to standard error
    log.disabled = False
    log.setLevel(logging.WARNING)
    console = Console(file=_Prefixed(sys.stdout, prefix)) if prefix else Console()  # type: ignore[arg-type]
    if sweep is None:
        console.print(tree("configuration", config))
    elif prefix:
        console.print(" ".join(overrides), highlight=False, markup=False, soft_wrap=True)
    else:
        console.rule(" ".join(overrides), align="left")
    if sweep is None and idle:  # some jobs of a sweep always have such options
        print(f"note: no effect with the chosen components: {', '.join(idle)}", file=sys.stderr)
    cpus = os.environ.get("SLURM_CPUS_PER_TASK")
    if cpus is not None and config["threads"] is None:
        if not re.fullmatch("[0-9]{1,9}", cpus):
            raise ValueError(f"SLURM_CPUS_PER_TASK must be a whole number, got {cpus!r}")
        config["threads"] = int(cpus)
    display = LiveDisplay(console, live=config["run"]["progress"])
    stopping = partial(_stopping, sweep)
    unpromising = _judge(sweep, config["store"])
    outcome = run(config, overrides, display, stopping, unpromising=unpromising)
    # Slurm restarts a job whose node died. The dead job owns the run until its last heartbeat is old enough.
    deadline = time.monotonic() + (PATIENCE if "SLURM_RESTART_COUNT" in os.environ else 0)
    while outcome.state == "busy" and time.monotonic() < deadline:
        display.note(f"{outcome.message}; waiting for its heartbeat to stop")
        time.sleep(RETRY)
        outcome = run(config, overrides, display, stopping, unpromising=unpromising)
    print_outcome(console, outcome, prefix)
    if outcome.state == "interrupted" and not prefix:
        sys.exit(ends.stopped_code())


def _judge(sweep: Sweep | None, store: str) -> Any:
    """What a job of a search gives up by; any other run is never given up."""
    if sweep is not None and HydraConfig.get().runtime.choices["hydra/sweeper"] == SEARCH:
        from qnerf.cli.search import judge

        if (found := judge(sweep.folder, Path(store))) is not None:
            return found
    return lambda path, step, measured: False


def _is_known(error: Exception) -> bool:
    """Whether one line is enough for the user to act on; any other error is a bug."""
    if is_shortage(error) or raised_in(error):
        return True
    from qnerf.training.trainer import Diverged

    return isinstance(error, (ValueError, OSError, Diverged, OmegaConfBaseException))


def _report(sweep: Sweep) -> int:
    """Prints which jobs of a sweep failed and why.

    Returns 130 or 141 if it was stopped, else 1 if a job failed, else 0.
    """
    failures = sweep.failures()
    if failures:
        table = Table("job", "reason", title=f"{len(failures)} failed")
        for overrides, reason in failures:
            table.add_row(Text(overrides), Text(reason))
        Console(stderr=True).print(table)
    if sweep.stopping():
        print("stopped; the same command continues from the last checkpoints", file=sys.stderr)
        return ends.stopped_code()
    return 1 if failures else 0


def _unknown_option(message: str) -> str:
    """The known options, if Hydra's message is about an unknown one; else nothing."""
    unknown = re.match(r"Could not override '([\w.@]+)'", message)
    if unknown is None:
        return ""
    group, _, _ = unknown[1].rpartition(".")
    options = [word for word in sys.argv[1:] if "=" in word and not word.startswith((unknown[1], "-", "hydra"))]
    with contextlib.suppress(HydraException, OmegaConfBaseException):
        with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
            config = hydra.compose("config", [word for word in options if "," not in word])
        node = OmegaConf.select(config, group) if group else config
        if isinstance(node, DictConfig):
            return f"unknown option {unknown[1]}; known: {', '.join(sorted(map(str, node)))}"
    return ""


def _composition_message(error: Exception) -> str:
    """Hydra's error about what the user typed, on one line."""
    if isinstance(error, MissingConfigException):
        group, _, name = str(error.missing_cfg_file).rpartition("/")
        known = f"known: {', '.join(error.options)}" if error.options else "--sweep NAME lists the sweeps"
        return f"{group or 'config'}={name}: unknown; {known}"
    unknown = _unknown_option(str(error))
    if unknown:
        return unknown
    if isinstance(error, OverrideParseException) and error.message.startswith("LexerNoViableAlt"):
        return f"{error.override}: cannot be read; quote a value that holds special characters: \"option='value'\""
    cause = f": {one_line(error.__cause__)}" if isinstance(error.__cause__, Exception) else ""
    return one_line(error).partition(" See https://hydra.cc")[0] + cause


def run_command() -> None:
    """Composes the configuration from conf/ and the command line, and runs it."""
    full_error = os.environ.get("HYDRA_FULL_ERROR", "0") not in ("", "0")
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises errors instead of printing them itself
    code: Any = 0
    try:
        arguments, options = typed.ordered(sys.argv[1:])
        sys.argv[1:] = typed.translated(arguments)
        typed.check(sys.argv[1:])
        for folder in filter(None, (options["config_dir"], options["config_path"])):
            check_file(Path(folder) / f"{(options['config_name'] or 'config').removesuffix('.yaml')}.yaml")
        plugins.load(typed.plugins(sys.argv[1:]))
    except ValueError as error:
        sys.exit(report(error))
    try:
        hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")(job)()
    except SystemExit as end:
        code = end.code
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        code = INTERRUPTED
    except Exception as error:
        if full_error or (_jobs and not _started):  # a job prints a user's mistake itself: this is a bug
            raise
        ended = ""
        if _started and not isinstance(error, HydraException):
            # The launcher failed: a process was killed for lack of memory, or a queue refused the job.
            ended = "the sweep ended early; the same command continues it: "
        print(f"error: {ended}{_composition_message(error)}", file=sys.stderr)
        code = 1
    reported = [_report(sweep) for sweep in _started]
    if code or any(reported):
        sys.exit(code or max(reported))
