"""One training, as `qnerf run`, a job of a sweep and `qnerf.run` start it."""

import os
import re
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

from qnerf import experiment
from qnerf.building.configuration import Configuration
from qnerf.building.scene import prepare
from qnerf.cli.sweep import RETRY
from qnerf.experiment import Display, Outcome

PATIENCE = 300.0  # seconds of attempts; longer than HEARTBEAT_LIMIT of `qnerf.records.owner`


def train(config: Mapping[str, Any] | Configuration, overrides: Sequence[str], display: Display) -> Outcome:
    """`qnerf.experiment.run` with what a job of Slurm needs: its threads, and patience after a restart."""
    configuration = Configuration.of(config)
    if configuration["threads"] is None:
        configuration = configuration.with_values({"threads": _threads_of_slurm()})
    prepared = prepare(configuration)

    def attempt() -> Outcome:
        return experiment.run(prepared, overrides, display)

    outcome = attempt()
    # Slurm restarts a job whose node died. The dead job owns the run until its last heartbeat is old enough.
    deadline = time.monotonic() + (PATIENCE if "SLURM_RESTART_COUNT" in os.environ else 0)
    while outcome.state == "busy" and time.monotonic() < deadline:
        display.note(f"{outcome.message}; waiting for its heartbeat to stop")
        time.sleep(RETRY)
        outcome = attempt()
    return outcome


def note_without_effect(configuration: Configuration, overrides: Sequence[str]) -> list[str]:
    """Names the options that the user typed and that change nothing; returns the others."""
    vain = configuration.without_effect(overrides)
    if vain:
        print(f"note: no effect with the chosen components: {', '.join(vain)}", file=sys.stderr)
    return [override for override in overrides if override not in vain]


def _threads_of_slurm() -> int | None:
    cpus = os.environ.get("SLURM_CPUS_PER_TASK")
    if cpus is not None and not re.fullmatch("[0-9]{1,9}", cpus):
        raise ValueError(f"SLURM_CPUS_PER_TASK must be a whole number, got {cpus!r}")
    return int(cpus) if cpus else None
