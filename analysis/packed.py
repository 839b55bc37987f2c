"""Runs packed into small tables, so that the evidence for a result can be kept beside it: what every table here is
made of, without pictures, curves and checkpoints. A packed folder is read like a store; `analysis.pack` makes one.
"""

from functools import lru_cache
from pathlib import Path

import pandas as pd

from qnerf.records import StoreError
from qnerf.records.read import read_table

RUNS, VIEWS, UNITS = "runs.parquet", "views.parquet", "units.parquet"
_HERE = ("path", "store", "heartbeat", "lpips_reason", "error", "threads", "device", "scene.path", "tags", "note")
"""Columns that say where and how a run was done on somebody's machine."""


def pack(runs: pd.DataFrame, folder: Path) -> int:
    """Writes runs as `analysis.load.runs` gives them, and of those that finished the held-out views and what the probe
    `units` found, over what the folder has; returns how many finished. What a scene is called is kept, where it lay is
    not.
    """
    chosen = runs.sort_values("run_id", ignore_index=True)
    finished = chosen[chosen["state"] == "finished"]
    parts, probed = [], []
    for name, path in zip(finished["run_id"], finished["path"], strict=True):
        rows = views(path)
        if rows is None:
            rows = read_table(Path(path) / "eval.parquet").to_pandas()
        parts.append(rows[["image", *rows.select_dtypes("number")]].assign(run_id=name))
        alive = units(path)
        if alive is not None:
            probed.append(alive.assign(run_id=name))
    folder.mkdir(parents=True, exist_ok=True)
    kept = chosen.drop(columns=[name for name in _HERE if name in chosen])
    kept.to_parquet(folder / RUNS, index=False)
    pd.concat(parts, ignore_index=True).to_parquet(folder / VIEWS, index=False)
    (folder / UNITS).unlink(missing_ok=True)
    if probed:
        pd.concat(probed, ignore_index=True).to_parquet(folder / UNITS, index=False)
    return len(finished)


def is_packed(folder: str | Path) -> bool:
    return (Path(folder) / RUNS).is_file()


def load(folder: str | Path) -> pd.DataFrame:
    """The frame that `analysis.load.runs` gives of a packed folder; `path` is where the run would lie in it."""
    frame = pd.read_parquet(Path(folder) / RUNS)
    return frame.assign(path=[str(Path(folder) / name) for name in frame["run_id"]])


def views(path: str | Path) -> pd.DataFrame | None:
    """The held-out views of a run whose `path` lies in a packed folder; None where it does not."""
    folder = Path(path).parent
    if not is_packed(folder):
        return None
    own = _of_runs(folder / VIEWS).get(Path(path).name)
    if own is None:
        raise StoreError(f"{path}: no such run in {folder / VIEWS}")
    return own


def units(path: str | Path) -> pd.DataFrame | None:
    """What `qnerf evaluate RUN units` found of a run, in a store or packed; None where it was not asked."""
    path = Path(path)
    if is_packed(path.parent):
        return _of_runs(path.parent / UNITS).get(path.name) if (path.parent / UNITS).is_file() else None
    return pd.read_parquet(path / UNITS) if (path / UNITS).is_file() else None


def _of_runs(file: Path) -> dict[str, pd.DataFrame]:
    return _read(file, file.stat().st_mtime_ns)


@lru_cache(maxsize=8)
def _read(file: Path, _changed: int) -> dict[str, pd.DataFrame]:
    return {str(name): rows for name, rows in pd.read_parquet(file).groupby("run_id", sort=False)}
