"""`hydra/launcher=side_by_side`: the jobs of a sweep train in one process, a step of each in turn."""

from collections.abc import Sequence
from typing import Any

from hydra._internal.core_plugins.basic_launcher import BasicLauncher
from hydra.core.utils import JobReturn

from qnerf.cli import launch
from qnerf.config.bounds import PositiveInt, check


class SideBySide(BasicLauncher):
    """runs: that train at once, at most."""

    def __init__(self, runs: Any) -> None:
        check("hydra.launcher.runs", runs, PositiveInt)
        super().__init__()
        self.runs = runs

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> list[JobReturn]:
        returned: list[JobReturn] = []
        for first in range(0, len(job_overrides), self.runs):
            with launch.together():
                returned += super().launch(job_overrides[first : first + self.runs], initial_job_idx + first)
        return returned
