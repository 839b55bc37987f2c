"""Everything about one run, as much of it as can be read."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import pandas as pd

from qnerf.config.identity import flatten
from qnerf.records import annotations
from qnerf.records.annotations import Annotations
from qnerf.records.files import StoreError, read_bytes, read_record, reporting
from qnerf.records.owner import moment
from qnerf.records.read import read_config, read_status, read_summary, read_table, state

_T = TypeVar("_T")


@dataclass
class Details:
    """A run as plain values.

    state: the true one. status: status.json. config: as nested as it was written. results: summary.parquet without the
    configuration and without absent values. environment: that of the run's start. evaluation: one row an image.
    problems: a line for each part that is damaged or missing, which is empty here then.
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
        return moment(self.status.get("created"))

    @property
    def heartbeat(self) -> float | None:
        """Unix time of the last sign of life."""
        return moment(self.status.get("heartbeat"))

    @property
    def step(self) -> int:
        step = self.status.get("step")
        return step if isinstance(step, int) else 0

    @property
    def steps(self) -> int | None:
        """Steps that the configuration asks for."""
        steps = self.flat.get("train.steps")
        return steps if isinstance(steps, int) else None

    @property
    def error(self) -> str | None:
        """Why the run failed."""
        error = self.status.get("error") or self.results.get("error")
        return str(error) if error else None


def read(run_dir: str | Path) -> Details:
    """A run's details; what is damaged is told in `problems` instead of raised."""
    folder = Path(run_dir).absolute()
    status = read_status(folder)
    details = Details(folder, state(folder, status), status)

    def attempt(reader: Callable[[], _T], otherwise: _T) -> _T:
        try:
            return reader()
        except StoreError as error:
            details.problems.append(str(error))
            return otherwise

    if not status:
        details.problems.append(f"{folder / 'status.json'}: missing or damaged")
    nothing: dict[str, Any] = {}
    details.config = attempt(lambda: read_config(folder), nothing)
    summary = attempt(lambda: read_summary(folder), nothing)
    flat = details.flat
    details.results = {key: value for key, value in summary.items() if key not in flat and value is not None}
    details.overrides = attempt(lambda: _lines(folder / "overrides.txt"), [])
    details.environment = attempt(lambda: _environment(folder / "environment.json"), nothing)
    details.evaluation = attempt(lambda: read_table(folder / "eval.parquet").to_pandas(), pd.DataFrame())
    details.annotations = attempt(lambda: annotations.read(folder), Annotations())
    return details


def _environment(path: Path) -> dict[str, Any]:
    if not path.exists():  # a run that has only just started, or that another program wrote
        return {}
    with reporting(path, "read"):
        try:
            return read_record(path)
        except StoreError:
            raise
        except ValueError as error:
            raise StoreError(f"{path}: damaged: {error}") from error


def _lines(path: Path) -> list[str]:
    if not path.exists():
        return []
    with reporting(path, "read"):
        return read_bytes(path, 2**20).decode(errors="replace").splitlines()
