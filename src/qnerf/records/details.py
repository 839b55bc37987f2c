"""Everything about one run, as far as it can be read."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import pandas as pd

from qnerf.config.identity import flatten
from qnerf.records import annotations
from qnerf.records.annotations import Annotations
from qnerf.records.files import StoreError, read_json, reporting
from qnerf.records.read import checked_status, read_config, read_evaluation, read_status, read_summary, state
from qnerf.records.schemas import results

_T = TypeVar("_T")
_U = TypeVar("_U")


@dataclass
class Details:
    """A run as plain values.

    state: as `records.state`, or damaged if summary.parquet or status.json is. status: status.json. config: nested, as
    in config.yaml. results: summary.parquet without the configuration and without absent values. environment: where
    the run started. evaluation: one row per image. problems: one line for each part that is damaged or missing; that
    part is empty here.
    """

    path: Path
    state: str
    status: dict[str, Any]
    config: dict[str, Any] = field(default_factory=dict)
    results: dict[str, Any] = field(default_factory=dict)
    overrides: list[str] = field(default_factory=list)
    environment: dict[str, Any] = field(default_factory=dict)
    evaluation: pd.DataFrame = field(default_factory=pd.DataFrame)
    annotations: Annotations = field(default_factory=Annotations)
    problems: list[str] = field(default_factory=list)

    @property
    def run_id(self) -> str:
        return self.path.name

    @property
    def flat(self) -> dict[str, Any]:
        """The configuration with dotted names."""
        return flatten(self.config)

    @property
    def created(self) -> float | None:
        """Unix time."""
        return self.status.get("created")

    @property
    def step(self) -> int:
        step = self.status.get("step")
        return step if isinstance(step, int) else 0

    @property
    def steps(self) -> int | None:
        """Training steps in the configuration."""
        steps = self.flat.get("train.steps")
        return steps if isinstance(steps, int) else None

    @property
    def error(self) -> str | None:
        """Why the run failed."""
        error = self.status.get("error") or self.results.get("error")
        return str(error) if error else None


def read(run_dir: str | Path) -> Details:
    """A run's details. Damaged parts are listed in `problems`; nothing is raised for them."""
    folder = Path(run_dir).absolute()
    status = read_status(folder)
    details = Details(folder, state(folder, status), status)

    def attempt(reader: Callable[[Path], _T], path: Path, default: _U) -> _T | _U:
        try:
            with reporting(path, "read"):
                return reader(path)
        except StoreError as error:
            details.problems.append(str(error))
            return default

    nothing: dict[str, Any] = {}
    attempt(checked_status, folder, nothing)
    summary = attempt(read_summary, folder, nothing)
    if details.problems:
        details.state = "damaged"
    details.config = attempt(read_config, folder, nothing)
    details.results = {name: value for name, value in results(summary, details.config).items() if value is not None}
    # A run that has just started, or that another program wrote, may lack these two.
    if (overrides := folder / "overrides.txt").exists():
        details.overrides = attempt(read_overrides, overrides, [])
    if (environment := folder / "environment.json").exists():
        details.environment = attempt(read_json, environment, nothing)
    details.evaluation = attempt(read_evaluation, folder, pd.DataFrame())
    details.annotations = attempt(annotations.read, folder, Annotations())
    return details


def read_overrides(path: Path) -> list[str]:
    """What the user typed to start the run, from its overrides.txt."""
    return path.read_text(errors="backslashreplace").splitlines()
