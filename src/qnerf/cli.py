"""The command line: `qnerf run` takes the same options as `python -m src.run`."""

import os
import sys

# Before PyTorch starts its threads: waiting threads sleep instead of spinning. A step is many small operations, and two
# spinning threads on a busy two-core machine slow it down more than tenfold.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException
from rich.console import Console
from rich.table import Table

FAILED: list[tuple[str, str]] = []
"""Jobs of this sweep that failed, with the reason: the others go on."""


def job(composed: DictConfig) -> None:
    """One job of a run or a sweep: from Hydra's configuration to the library, and its errors to one line."""
    from qnerf.console import LiveDisplay, print_config, print_outcome
    from qnerf.experiment import run
    from qnerf.train import Diverged

    console = Console()
    overrides = list(HydraConfig.get().overrides.task)
    debug = bool(composed.run.debug)
    sweeping = HydraConfig.get().mode == RunMode.MULTIRUN
    try:
        config: dict[str, Any] = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)  # type: ignore[assignment]
        if sweeping:
            console.rule(" ".join(overrides), align="left")
        else:
            print_config(console, config)
        outcome = run(config, overrides, LiveDisplay(console, live=config["run"]["progress"]))
        print_outcome(console, outcome)
    except KeyboardInterrupt:
        print("stopped; the same command goes on from the last checkpoint", file=sys.stderr)
        sys.exit(130)
    except (ValueError, OSError, Diverged, OmegaConfBaseException) as error:
        if debug:
            raise
        reason = one_line(error)
        print(f"error: {reason}", file=sys.stderr)
        if not sweeping:
            sys.exit(2)
        FAILED.append((" ".join(overrides), reason))
        return
    if outcome.state == "interrupted":
        sys.exit(130)


def one_line(error: Exception) -> str:
    if isinstance(error, MissingMandatoryValue):
        return f"{error.full_key} must be given"
    return " ".join(str(error).split("\n    full_key")[0].split())


def report_failures() -> None:
    """After a sweep: what failed and why; exit code 1 if anything did."""
    if not FAILED:
        return
    table = Table("job", "reason", title=f"{len(FAILED)} failed")
    for overrides, reason in FAILED:
        table.add_row(overrides, reason)
    Console(stderr=True).print(table)
    sys.exit(1)


def conf_folder() -> Path:
    """conf/ beside src/ in a checkout, inside the package in an installed wheel."""
    package = Path(__file__).parent
    return package / "conf" if (package / "conf").is_dir() else package.parents[1] / "conf"


def run_command() -> None:
    """Composes the configuration from conf/ and the command line, and runs it."""
    hydra.main(version_base="1.3", config_path=str(conf_folder()), config_name="config")(job)()
    report_failures()


def evaluate_command(arguments: list[str]) -> None:
    """`qnerf evaluate RUN shots=100,1000 noise=depolarizing p=0.001,0.01 views=0 seed=0`."""
    from qnerf.evaluate_hardware import FILE, evaluate_hardware, grid

    options = {"shots": "", "noise": "depolarizing", "p": "", "views": "0", "seed": "0"}
    folders = [argument for argument in arguments if "=" not in argument]
    if len(folders) != 1:
        raise ValueError(f"qnerf evaluate expects one run's folder, got {' '.join(folders) or 'none'}")
    for argument in arguments:
        key, _, value = argument.partition("=")
        if argument in folders:
            continue
        if key not in options:
            raise ValueError(f"qnerf evaluate: unknown option {key!r}; known: {', '.join(options)}")
        options[key] = value
    shots, p = _numbers(int, "shots", options["shots"]), _numbers(float, "p", options["p"])
    (views,), (seed,) = _numbers(int, "views", options["views"]), _numbers(int, "seed", options["seed"])
    evaluate_hardware(folders[0], grid(shots, options["noise"], p, seed), views=views, tell=print)
    print(f"rows in {Path(folders[0]) / FILE}")


def _numbers(kind: type, name: str, text: str) -> list[Any]:
    try:
        return [kind(part) for part in text.split(",") if part]
    except ValueError:
        raise ValueError(f"{name} expects numbers with commas between them, got {text!r}") from None


USAGE = """usage: qnerf COMMAND ...

commands:
  run [OVERRIDE ...]      train and evaluate; `qnerf run --help` lists the groups and their choices
  evaluate RUN [shots=100,1000] [noise=depolarizing p=0.001,0.01] [views=0] [seed=0]
                          render a finished run's held-out views as hardware would: finite shots, noisy gates"""


def main() -> None:
    """The console command `qnerf`."""
    command = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if command == "run":
        sys.argv = ["qnerf run", *sys.argv[2:]]
        run_command()
    elif command == "evaluate":
        try:
            evaluate_command(sys.argv[2:])
        except (ValueError, OSError) as error:
            sys.exit(f"error: {one_line(error)}")
    elif command in ("-h", "--help"):
        print(USAGE)
    else:
        print(f"error: unknown command {command!r}; known: run, evaluate", file=sys.stderr)
        sys.exit(2)
