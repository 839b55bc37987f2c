"""Runs packed into a few small tables, without pictures, curves and checkpoints, to keep as evidence for a result.

`analysis.pack` writes such a folder. It is read like a store, and every table here can be made from it.
"""

from functools import lru_cache
from pathlib import Path

import pandas as pd

from qnerf.records import StoreError
from qnerf.records.read import read_table

RUNS, VIEWS = "runs.parquet", "views.parquet"
PROBES = ("units", "eval_hardware")
"""Tables that `qnerf probe` leaves in a run's folder and that are small enough to keep."""
_HERE = ("path", "store", "heartbeat", "lpips_reason", "error", "threads", "device", "scene.path", "tags", "note")
"""Columns about the machine that a run was done on, which are not packed."""


def pack(runs: pd.DataFrame, folder: Path) -> int:
    """Writes runs from `analysis.load.runs`, and the held-out views and `PROBES` of the finished ones; returns their
    number. Files that the folder has are replaced. A scene's name is packed, its location is not.
    """
    chosen = runs.sort_values("run_id", ignore_index=True)
    finished = chosen[chosen["state"] == "finished"]
    parts = []
    probed: dict[str, list[pd.DataFrame]] = {probe: [] for probe in PROBES}
    for name, path in zip(finished["run_id"], finished["path"], strict=True):
        rows = views(path)
        if rows is None:
            rows = read_table(Path(path) / "eval.parquet").to_pandas()
        parts.append(rows[["image", *rows.select_dtypes("number")]].assign(run_id=name))
        for probe, tables in probed.items():
            if has(path, probe):
                tables.append(found(path, probe).assign(run_id=name))
    folder.mkdir(parents=True, exist_ok=True)
    portable = chosen.drop(columns=[name for name in _HERE if name in chosen])
    portable.to_parquet(folder / RUNS, index=False)
    pd.concat(parts, ignore_index=True).to_parquet(folder / VIEWS, index=False)
    for probe, tables in probed.items():
        (folder / f"{probe}.parquet").unlink(missing_ok=True)
        if tables:
            pd.concat(tables, ignore_index=True).to_parquet(folder / f"{probe}.parquet", index=False)
    return len(finished)


def is_packed(folder: str | Path) -> bool:
    return (Path(folder) / RUNS).is_file()


def load(folder: str | Path) -> pd.DataFrame:
    """The frame of `analysis.load.runs` for a packed folder; a run's `path` is the folder and its id."""
    frame = pd.read_parquet(Path(folder) / RUNS)
    return frame.assign(path=[str(Path(folder) / name) for name in frame["run_id"]])


def views(path: str | Path) -> pd.DataFrame | None:
    """The held-out views of a run in a packed folder; None where `path` is not in one."""
    folder = Path(path).parent
    if not is_packed(folder):
        return None
    own = _of_runs(folder / VIEWS).get(Path(path).name)
    if own is None:
        raise StoreError(f"{path}: no such run in {folder / VIEWS}")
    return own


def has(path: str | Path, probe: str) -> bool:
    """Whether a run, in a store or packed, has a table of that name from `qnerf probe`."""
    path = Path(path)
    if not is_packed(path.parent):
        return (path / f"{probe}.parquet").is_file()
    file = path.parent / f"{probe}.parquet"
    return file.is_file() and path.name in _of_runs(file)


def found(path: str | Path, probe: str) -> pd.DataFrame:
    """The table of a probe; check with `has` first."""
    path = Path(path)
    if is_packed(path.parent):
        return _of_runs(path.parent / f"{probe}.parquet")[path.name]
    return read_table(path / f"{probe}.parquet").to_pandas()


def _of_runs(file: Path) -> dict[str, pd.DataFrame]:
    return _read(file, file.stat().st_mtime_ns)


@lru_cache(maxsize=8)
def _read(file: Path, _changed: int) -> dict[str, pd.DataFrame]:
    return {str(name): rows for name, rows in pd.read_parquet(file).groupby("run_id", sort=False)}
