"""Runs packed into a few small tables, without pictures, curves and checkpoints, to keep as evidence for a result.

`qnerf pack` writes such a folder. It is read like a store, and every table here can be made from it.
"""

import re
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

import pandas as pd

from qnerf.records import StoreError
from qnerf.records.files import replace
from qnerf.records.parquet import require_columns
from qnerf.records.read import checked_table, read_evaluation, read_probe, read_table
from qnerf.records.schemas import known_kind

from .decide.records import FOLDER as RECORDS
from .output import make_folder

RUNS, VIEWS = "runs.parquet", "views.parquet"
PROBES = ("units", "cost", "eval_hardware")
"""Tables that `qnerf probe` leaves in a run's folder and that are small enough to keep."""
_HERE = ("path", "store", "heartbeat", "lpips_reason", "error", "threads", "device", "scene.path")
"""Columns about the machine that a run was done on, which are not packed."""


def pack(runs: pd.DataFrame, folder: Path) -> tuple[int, list[str]]:
    """Writes runs from `load.runs`, the held-out views and `PROBES` of the finished ones, and the store's studies.

    Returns the number of finished runs, and a line for each damaged file. A run without readable views is packed as
    damaged. Files that the folder has are replaced. A scene's name is packed, its location is not.
    """
    chosen = runs.sort_values("run_id", ignore_index=True)
    finished = chosen[chosen["state"] == "finished"]
    parts: list[pd.DataFrame] = []
    problems = []
    for number, name, path in zip(finished.index, finished["run_id"], finished["path"], strict=True):
        try:
            rows = views(path)
        except StoreError as error:
            problems.append(str(error))
            chosen.loc[number, "state"] = "damaged"
            continue
        parts.append(rows[["image", *rows.select_dtypes("number")]].assign(run_id=name))
    if not parts:
        raise StoreError(problems[0])
    portable = chosen.drop(columns=[name for name in _HERE if name in chosen])
    tables = {"views": pd.concat(parts, ignore_index=True), "runs": portable}
    for probe in PROBES:
        own, damaged = probe_tables(finished["path"], probe)
        problems += filter(None, [damaged])
        if own:
            named = [table.assign(run_id=Path(path).name) for path, table in own.items()]
            tables[probe] = pd.concat(named, ignore_index=True)
    make_folder(folder, store=False)
    for probe in PROBES if is_packed(folder) else ():
        if probe not in tables:
            (folder / f"{probe}.parquet").unlink(missing_ok=True)
    for name, frame in tables.items():
        replace(folder / f"{name}.parquet", frame.to_parquet(index=False), durable=False)
    stores = {Path(path).parent for path in chosen["path"]}  # with --add also the folder itself
    for record in (path for store in stores for path in store.glob(f"{RECORDS}/*.json")):
        make_folder(folder / RECORDS, store=False)
        text = re.sub(r"scene\.path=\S*/", "scene.path=", record.read_text())
        replace(folder / RECORDS / record.name, text.encode(), durable=False)
    return len(parts), problems


def is_packed(folder: str | Path) -> bool:
    """Whether the folder has both tables that every packed folder has; one alone is a stray file in a store."""
    return all((Path(folder) / name).is_file() for name in (RUNS, VIEWS))


def _kind(name: str) -> str | None:
    """The kind of a column; pandas has no absent integers."""
    kind = known_kind(name)
    return "float" if kind == "int" else kind


def load(folder: str | Path) -> pd.DataFrame:
    """The frame of `load.runs` for a packed folder; a run's `path` is the folder and its id.

    Raises:
        StoreError: the table is damaged.
    """
    file = Path(folder) / RUNS
    table = require_columns(read_table(file, _kind), {"run_id": "text", "state": "text"}, file)
    frame = table.to_pandas()
    return frame.assign(path=[str(Path(folder) / name) for name in frame["run_id"]])


def views(path: str | Path) -> pd.DataFrame:
    """The held-out views of a run in a store or in a packed folder; StoreError if they are absent or damaged."""
    path = Path(path)
    if not is_packed(path.parent):
        return read_evaluation(path)
    file = path.parent / VIEWS
    own = _of_runs(file, "eval").get(path.name)
    if own is None:
        raise StoreError(f"{path}: no such run in {file}")
    return own


def probe_table(path: str | Path, probe: str) -> pd.DataFrame | None:
    """The table of a probe of a run, in a store or packed; None if it was not probed. StoreError if it is damaged."""
    path = Path(path)
    if not is_packed(path.parent):
        return read_probe(path, probe) if (path / f"{probe}.parquet").is_file() else None
    file = path.parent / f"{probe}.parquet"
    return _of_runs(file, probe).get(path.name) if file.is_file() else None


def probe_tables(paths: Iterable[str], probe: str) -> tuple[dict[str, pd.DataFrame], str]:
    """Run -> its table of a probe, for the runs that have a readable one, and a note that counts the damaged ones."""
    tables, damaged = {}, []
    for path in paths:
        try:
            own = probe_table(path, probe)
        except StoreError as error:
            damaged.append(str(error))
            continue
        if own is not None:
            tables[path] = own
    return tables, f"left out: {len(damaged)} damaged, the first {damaged[0]}" if damaged else ""


def _of_runs(file: Path, name: str) -> dict[str, pd.DataFrame]:
    return _read(file, name, file.stat().st_mtime_ns)


@lru_cache(maxsize=8)
def _read(file: Path, name: str, _changed: int) -> dict[str, pd.DataFrame]:
    table = checked_table(require_columns(read_table(file), {"run_id": "text"}, file), name, file)
    return {str(run): rows for run, rows in table.to_pandas().groupby("run_id", sort=False)}
