"""Everything about one run, as far as it can be read."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from qnerf.records.files import StoreError, read_json, reporting
from qnerf.records.read import checked_status, read_config, read_evaluation, read_status, read_summary, state
from qnerf.records.schemas import results

_T = TypeVar("_T")


def read(run_dir: str | Path) -> dict[str, Any]:
    """A run as plain values; nothing is raised for what is damaged.

    state: as `records.state`, or damaged if summary.parquet or status.json is. error: why the run failed. problems: one
    line for each part that is damaged or missing; that part is empty here. step: the last one logged. config: nested.
    results: summary.parquet without the configuration and without absent values. evaluation: one row per image.
    overrides: what the user typed. environment: where the run started. status: status.json.
    """
    folder = Path(run_dir).absolute()
    problems: list[str] = []

    def attempt(reader: Callable[[Path], _T], path: Path, default: _T) -> _T:
        try:
            with reporting(path, "read"):
                return reader(path)
        except StoreError as error:
            problems.append(str(error))
            return default

    nothing: dict[str, Any] = {}
    no_lines: list[str] = []
    no_rows: list[dict[Any, Any]] = []
    attempt(checked_status, folder, nothing)
    summary = attempt(read_summary, folder, nothing)
    status = read_status(folder)
    now = "damaged" if problems else state(folder, status)
    config = attempt(read_config, folder, nothing)
    measured = {name: value for name, value in results(summary, config).items() if value is not None}
    # A run that has just started, or that another program wrote, may lack these two.
    overrides, environment = folder / "overrides.txt", folder / "environment.json"
    return {
        "run_id": folder.name,
        "path": str(folder),
        "state": now,
        "error": status.get("error") or summary.get("error"),
        "step": status.get("step", 0),
        "results": measured,
        "evaluation": attempt(lambda run: read_evaluation(run).to_dict("records"), folder, no_rows),
        "overrides": attempt(read_overrides, overrides, no_lines) if overrides.exists() else [],
        "config": config,
        "environment": attempt(read_json, environment, nothing) if environment.exists() else {},
        "status": status,
        "problems": problems,
    }


def read_overrides(path: Path) -> list[str]:
    """What the user typed to start the run, from its overrides.txt."""
    return path.read_text(errors="backslashreplace").splitlines()
