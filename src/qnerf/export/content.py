"""What the exporters copy from a run."""

from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from qnerf.records import StoreError, details, pictures, read_metrics
from qnerf.records.details import Details

FILES = ("config.yaml", "overrides.txt", "environment.json", "dirty.diff", "eval.parquet", "summary.parquet")


@dataclass(frozen=True)
class Content:
    """A run with its metrics (step, time_s, key, value in the order of logging).

    created, ended: Unix times of the start and of the last heartbeat. step: the last one logged.
    """

    run: Details
    created: float
    ended: float
    step: int
    metrics: pd.DataFrame
    files: list[Path]
    images: list[Path]

    @property
    def results(self) -> dict[str, object]:
        return {name: value for name, value in self.run.results.items() if name not in ("run_id", "state")}


def read(folder: Path) -> Content:
    """Reads a run as it is now, running or ended; StoreError if a part of it is damaged."""
    run = details.read(folder)
    if run.problems:
        raise StoreError(run.problems[0])
    created = run.created or (run.path / "config.yaml").stat().st_mtime
    metrics = read_metrics(run.path)
    return Content(
        run=run,
        created=created,
        ended=run.heartbeat or created,
        step=int(metrics["step"].max()) if len(metrics) else 0,
        metrics=metrics,
        files=sorted(path for pattern in FILES for path in run.path.glob(pattern) if not path.is_symlink()),
        images=pictures.listed(run.path),
    )


def make_folder(out: Path, run: Path) -> Path:
    """Makes the folder of a run's copy, `<out>/<run id>`; ValueError if that is the run itself or in it."""
    folder = out / run.name
    if folder.resolve().is_relative_to(run.resolve()):
        raise ValueError(f"{folder}: is in a run's folder; expected another --out")
    folder.mkdir(parents=True, exist_ok=True)
    return folder
