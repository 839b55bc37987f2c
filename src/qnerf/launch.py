"""Hydra's side: composes the configuration from conf/ and the command line, and hands each job to the library."""

import sys
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console
from rich.table import Table

from qnerf.errors import one_line

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
