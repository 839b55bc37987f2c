"""What the exporters copy from a run."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from qnerf.records import StoreError, details, files, pictures, read_metrics
from qnerf.records.annotations import Annotations
from qnerf.records.deletion import refuse_runs
from qnerf.records.files import files_in, reporting
from qnerf.records.location import RUN_ID

_FILES = ("config.yaml", "overrides.txt", "environment*.json", "dirty*.diff", "eval.parquet", "summary.parquet")


@dataclass(frozen=True)
class Content:
    """A run as plain values.

    created, ended: Unix times of the start and of the last heartbeat. step: the last one logged. config: flat.
    results: from summary.parquet. metrics: step, time_s, key, value, in the order of logging. files, images: paths
    without links.
    """

    run_id: str
    state: str
    created: float
    ended: float
    step: int
    config: dict[str, Any]
    results: dict[str, Any]
    commit: str | None
    evaluation: pd.DataFrame
    annotations: Annotations
    metrics: pd.DataFrame
    files: list[Path]
    images: list[Path]


def read(folder: Path) -> Content:
    """Reads a run as it is now, running or ended.

    Raises:
        StoreError: the folder's name is not a run id, or a part of the run is damaged.
    """
    run = details.read(folder)
    if not RUN_ID.fullmatch(run.run_id):
        raise StoreError(f"expected a run's id of letters, digits, '.', '_' and '-', got {run.run_id!r}")
    if run.problems:
        raise StoreError(run.problems[0])
    created = run.created or (run.path / "config.yaml").stat().st_mtime
    git = run.environment.get("git")
    commit = git.get("commit") if isinstance(git, dict) else None
    metrics = read_metrics(run.path)
    return Content(
        run_id=run.run_id,
        state=run.state,
        created=created,
        ended=run.heartbeat or created,
        step=int(metrics["step"].max()) if len(metrics) else 0,
        config=_encodable(run.flat),
        results=_encodable({name: value for name, value in run.results.items() if name not in ("run_id", "state")}),
        commit=str(commit) if commit else None,
        evaluation=run.evaluation,
        annotations=Annotations(tuple(_encodable(list(run.annotations.tags))), _encodable(run.annotations.note)),
        metrics=metrics,
        files=[path for pattern in _FILES for path in files_in(run.path, pattern)],
        images=pictures.listed(run.path),
    )


def make_folder(out: Path, run_id: str) -> Path:
    """Makes the folder of a run's copy, `<out>/<run_id>`.

    Raises:
        StoreError: it cannot be made or is a link.
        ValueError: it is in a run's folder.
    """
    folder = out / run_id
    refuse_runs(folder)
    with reporting(folder):
        out.mkdir(parents=True, exist_ok=True)
        files.make_folder(folder, root=out)
    return folder


def _encodable(value: Any) -> Any:
    r"""The value with escapes such as `\ud800` for halves of characters, which JSON can hold and UTF-8 cannot."""
    if isinstance(value, str):
        return value.encode(errors="backslashreplace").decode()
    if isinstance(value, list):
        return [_encodable(item) for item in value]
    if isinstance(value, dict):
        return {_encodable(name): _encodable(item) for name, item in value.items()}
    return value
