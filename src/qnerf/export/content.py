"""What the exporters copy from a run."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from qnerf.records import StoreError, details, pictures, read_metrics
from qnerf.records.annotations import Annotations
from qnerf.records.files import files_in

_RUN_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
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
        ValueError: the folder's name is not a run id.
        StoreError: a part of the run is damaged.
    """
    run = details.read(folder)
    if not _RUN_ID.fullmatch(run.run_id):
        raise ValueError(f"expected a run's id of letters, digits, '.', '_' and '-', got {run.run_id!r}")
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
        config=run.flat,
        results={name: value for name, value in run.results.items() if name not in ("run_id", "state")},
        commit=str(commit) if commit else None,
        evaluation=run.evaluation,
        annotations=run.annotations,
        metrics=metrics,
        files=[path for pattern in _FILES for path in files_in(run.path, pattern)],
        images=pictures.listed(run.path),
    )
