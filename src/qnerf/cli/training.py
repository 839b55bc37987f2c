"""One training, as `qnerf run`, a job of a sweep and `qnerf.run` start it."""

import os
import re
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from qnerf import experiment
from qnerf.building.configuration import Configuration
from qnerf.building.scene import prepare
from qnerf.cli.sweep import RETRY
from qnerf.experiment import Display, Job, Outcome
from qnerf.scenes import Scene

PATIENCE = 300.0  # seconds of attempts; longer than HEARTBEAT_LIMIT of `qnerf.records.owner`


def train(config: Mapping[str, Any] | Configuration, overrides: Sequence[str], display: Display) -> Outcome:
    """`qnerf.experiment.run` with what a job of Slurm needs: its threads, and patience after a restart."""
    prepared = prepare(_with_threads(Configuration.of(config)))

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


def train_beside(
    asked: Sequence[tuple[Configuration, Sequence[str], Display]],
) -> Iterator[tuple[int, Outcome | Exception]]:
    """`qnerf.experiment.side_by_side` of these configurations, which share what they read of a scene.

    Yields the place of each and how it has ended; interrupted ones come last, and then no other begins. Those on
    another device, or of a run that stands there already, come after the others.
    """
    groups: list[dict[str, tuple[int, Job]]] = []
    scenes: dict[str, Scene] = {}
    for number, (configuration, overrides, display) in enumerate(asked):
        try:
            key = repr(configuration.complete["scene"])
            prepared = prepare(_with_threads(configuration), scenes.get(key))
        except Exception as error:
            yield number, error
            continue
        if isinstance(prepared.source, Scene):
            scenes[key] = prepared.source
        job = Job(prepared, overrides, display, prepared.find_id(prepared.settings.store))
        fitting = (
            group
            for group in groups
            if job.name not in group and all(other.device == job.device for _, other in group.values())
        )
        group = next(fitting, None)
        if group is None:
            groups.append(group := {})
        group[job.name] = number, job
    for group in groups:
        numbers, jobs = zip(*group.values(), strict=True)
        ended = list(zip(numbers, experiment.side_by_side(jobs), strict=True))
        stopped = [isinstance(outcome, Outcome) and outcome.state == "interrupted" for _, outcome in ended]
        yield from (one for _, one in sorted(zip(stopped, ended, strict=True), key=lambda pair: pair[0]))
        if any(stopped):
            return


def note_without_effect(configuration: Configuration, overrides: Sequence[str]) -> list[str]:
    """Names the options that the user typed and that change nothing; returns the others."""
    vain = configuration.without_effect(overrides)
    if vain:
        print(f"note: no effect with the chosen components: {', '.join(vain)}", file=sys.stderr)
    return [override for override in overrides if override not in vain]


def _with_threads(configuration: Configuration) -> Configuration:
    """With Slurm's number of threads, unless it has one."""
    if configuration["threads"] is not None:
        return configuration
    cpus = os.environ.get("SLURM_CPUS_PER_TASK")
    if cpus is not None and not re.fullmatch("[0-9]{1,9}", cpus):
        raise ValueError(f"SLURM_CPUS_PER_TASK must be a whole number, got {cpus!r}")
    return configuration.with_values({"threads": int(cpus)}) if cpus else configuration
