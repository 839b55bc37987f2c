"""What happens once, in the process that starts a sweep: its folder, and this package's plugins."""

import importlib.util
import sys
from pathlib import Path
from typing import Any

from hydra.core.plugins import Plugins
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, open_dict, read_write
from omegaconf.errors import OmegaConfBaseException

from qnerf.cli import sweep as sweeps
from qnerf.cli.errors import report
from qnerf.cli.sweep import Grid, Sweep

EXTRAS = {
    "submitit_local": ("hydra_plugins.hydra_submitit_launcher", "slurm"),
    "submitit_slurm": ("hydra_plugins.hydra_submitit_launcher", "slurm"),
    "qnerf_optuna": ("optuna", "search"),
}
"""Launcher or sweeper -> the module that it needs, and the extra that installs it."""

GRID, SEARCH = "hydra_plugins.qnerf.Grid", "hydra_plugins.qnerf_optuna.OptunaSweeper"
SIDE_BY_SIDE = "hydra_plugins.qnerf.SideBySide"


class SweepStart(Callback):
    """Prepares a sweep, once, in the process that starts it."""

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        try:
            launcher, sweeper = (config.hydra.runtime.choices[f"hydra/{kind}"] for kind in ("launcher", "sweeper"))
            for name in (launcher, sweeper):
                _require(name)
            if not config.store:
                raise ValueError("store must not be empty")  # the sweep's folder is inside
            sweep = Sweep(Path(config.hydra.sweep.dir).absolute(), config.hydra.overrides.task)
        except (ValueError, OmegaConfBaseException) as error:
            sys.exit(report(error))  # Hydra would only warn
        sweeps.started.append(sweep)
        # Jobs compose their configuration again from these overrides and must use this folder, not one of their own.
        quoted = str(sweep.folder).replace("'", "\\'")
        with read_write(config.hydra), open_dict(config.hydra):  # Hydra 1.4 gives it read-only
            config.hydra.sweep.dir = str(sweep.folder)
            config.hydra.overrides.hydra.append(f"hydra.sweep.dir='{quoted}'")
        _register(launcher, sweeper)
        if launcher == "submitit_slurm":
            print(f"jobs go to Slurm, output is in {sweep.folder / 'jobs'}; Ctrl-C does not stop the jobs", flush=True)


def _register(launcher: str, sweeper: str) -> None:
    """Puts this package's plugins where Hydra keeps those that it has found in `hydra_plugins`."""
    Plugins.instance().class_name_to_class[GRID] = Grid
    if launcher == "side_by_side":
        from qnerf.cli.side_by_side import SideBySide

        Plugins.instance().class_name_to_class[SIDE_BY_SIDE] = SideBySide
    if sweeper == "qnerf_optuna":
        from qnerf.cli.search import OptunaSweeper

        Plugins.instance().class_name_to_class[SEARCH] = OptunaSweeper


def _require(name: str) -> None:
    """ValueError if a launcher or a sweeper needs an extra that is not installed."""
    if name in EXTRAS:
        module, extra = EXTRAS[name]
        if any(importlib.util.find_spec(part) is None for part in (module.partition(".")[0], module)):
            raise ValueError(f'{name} needs a package that is not installed: pip install "qnerf[{extra}]"')
