"""Runs that other programs wrote: any table with a row a run, an MLflow store, a Trackio database.

What a column is, a setting, a metric or the seed, is known or guessed, said in one line, and declared: metrics join
`METRICS`, settings `selection.NAMED`, and a column that names the scene is one more alias of `scene_name`.
"""

import contextlib
import json
import os
import re
import sqlite3
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from qnerf.metrics import METRICS, Metric, metric_of
from qnerf.records import filters
from qnerf.records.files import one_line

from .selection import NAMED

TABLES, DATABASES = (".csv", ".parquet"), (".db", ".sqlite", ".sqlite3")
SCENES = ("scene_name", "scene", "dataset")
"""Columns that name what is learnt; runs of different ones are never averaged."""
_SEED = re.compile(r"(.*[._/ ])?(seed|random_seed|random_state|rng_seed|replicate|repeat)", re.IGNORECASE)
_ABOUT = re.compile(
    r"_.*|unnamed: \d+|index|(run_?)?(id|name)|state|status|notes?|tags?|user|created|updated|sweep|host(name)?|"
    r"machine|path|error|step|date|group|.*time_?stamp|(start|end)_time",
    re.IGNORECASE,
)
"""Columns that say something about a run, but are neither settings nor metrics."""
_RESULT = re.compile(
    r"(.*[._/ -])?(acc(uracy)?|loss|error|score|f1|auc|reward|recall|perplexity|r?mse|mae)", re.IGNORECASE
)
"""Numbers with such a name are metrics, also where many runs share their value."""
_TIME = re.compile(r".*(time|runtime|seconds|duration|latency)|.*_m?s", re.IGNORECASE)
_FINISHED, _RUNNING = ("finished", "completed", "complete", "done", "success"), ("running", "scheduled", "pending")


def is_foreign(store: object) -> bool:
    """Whether it is a frame, a table, a database or an MLflow folder, and no folder of runs."""
    if isinstance(store, pd.DataFrame):
        return True
    path = Path(str(store))
    return path.suffix in (*TABLES, *DATABASES) or any(path.glob("*/meta.yaml"))


def read(
    store: str | Path | pd.DataFrame,
    *,
    metrics: Sequence[str] | None = None,
    settings: Sequence[str] | None = None,
    seed: str | None = None,
    scene: str | None = None,
) -> pd.DataFrame:
    """The frame of `load.runs` for runs of another program; prints to standard error what each column is taken for.

    store: a frame, a .csv or .parquet file, a database of Trackio or MLflow, or MLflow's folder. A metric that is
    logged over steps has its last value. metrics, settings, seed, scene: columns; what is None is guessed. Metrics are
    then the numbers that differ where all settings are equal, and the first one is what verdicts are about.

    Raises:
        ValueError: it cannot be read, has no such column, or no metric.
    """
    table, known, name = _table(store)
    given = [*(metrics or ()), *(settings or ()), *filter(None, [seed, scene])]
    for column in given:
        filters.check_column(column, table.columns)
    columns = [str(column) for column in table if not _ABOUT.fullmatch(str(column)) or column in given]
    columns = [column for column in columns if table[column].notna().any()]
    seeds = [column for column in columns if _SEED.fullmatch(column)]
    seed = seed or max(seeds, key=lambda column: table[column].nunique(), default=None)  # another one is a setting
    scene = scene or next((column for column in SCENES if column in table), None)
    copies = table.duplicated([column for column in table if column in columns or column == scene]) & bool(seed)
    table = table[~copies].reset_index(drop=True)  # a run that counts twice would look like another seed
    others = [column for column in columns if column not in (seed, scene)]
    metrics = list(metrics or known or _metrics(table, others, settings, seed, scene))
    if not metrics:
        raise ValueError(
            f"{name}: no number differs between runs of equal settings; --metrics names results, of {_list(others)}"
        )
    if settings is None:
        others = [column for column in others if column not in metrics]
        told = {*_replicated(table, others, seed, scene), *table.select_dtypes("number").columns}
        settings = [column for column in others if column in told]
    frame = pd.DataFrame(
        {
            "run_id": _ids(table),
            "state": _states(table),
            "scene_name": table[scene].astype(str) if scene else Path(name).stem,
            "seed": table[seed] if seed else np.nan,
            **{column: table[column] for column in settings},
            **{_plain(column): table[column].astype(float) for column in metrics},
        }
    )
    _declare(metrics, settings, scene)
    said = {"settings": settings, "seed": [seed or "none"], "scene": [scene] if scene else []}
    text = "; ".join(f"{kind} {_list(names)}" for kind, names in said.items() if names)
    names = list(map(_plain, metrics))
    text += f"; metrics {_list(names)}"
    text += f"; {copies.sum():,} repeated rows left out" * bool(copies.any())
    lower = [name for name in names if metric_of(name).sign < 0]
    print(f"{name}: {len(frame)} runs; {text}" + f" (less is better: {_list(lower)})" * bool(lower), file=sys.stderr)
    return frame.assign(path=[str(Path(name) / run) for run in frame["run_id"]])


def _table(store: str | Path | pd.DataFrame) -> tuple[pd.DataFrame, list[str], str]:
    """The table, its metrics where the program says them, and the name of the store."""
    if isinstance(store, pd.DataFrame):
        return store.reset_index(drop=True), [], "table"
    path, name = Path(store), str(store)
    try:
        if not path.exists():
            raise ValueError("no such file")
        if path.suffix in TABLES:
            return pd.read_csv(path) if path.suffix == ".csv" else pd.read_parquet(path), [], name
        if path.is_dir() or _has(path, "latest_metrics"):
            return *_mlflow(path), name
        if _has(path, "configs"):
            return *_trackio(path), name
    except (OSError, ValueError, sqlite3.Error) as error:
        raise ValueError(f"{name}: {one_line(error)}") from error
    raise ValueError(f"{name}: expected a database of MLflow or Trackio")


def _has(path: Path, table: str) -> bool:
    with contextlib.closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as database:
        return bool(list(database.execute("SELECT 1 FROM sqlite_master WHERE name = ?", [table])))


def _mlflow(path: Path) -> tuple[pd.DataFrame, list[str]]:
    try:
        from mlflow import MlflowClient  # type: ignore[import-not-found]
    except ImportError:
        raise ValueError("a store of MLflow is read by MLflow: pip install mlflow") from None
    os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")
    address = path.absolute()
    client = MlflowClient(address.as_uri() if path.is_dir() else f"sqlite:///{address}")
    found = client.search_experiments()
    experiments = {one.experiment_id: one.name for one in found}
    runs, token = [], None
    while True:
        page = client.search_runs(list(experiments), max_results=1000, page_token=token)
        runs += [*page]
        if (token := page.token) is None:
            break
    rows = [
        {"run_id": one.info.run_id, "state": one.info.status, "scene_name": experiments[one.info.experiment_id]}
        | one.data.params
        | one.data.metrics
        for one in runs
    ]
    return _numbers(pd.DataFrame(rows)), list(dict.fromkeys(key for one in runs for key in one.data.metrics))


def _trackio(path: Path) -> tuple[pd.DataFrame, list[str]]:
    with contextlib.closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as database:
        configs = {name: json.loads(text) for name, text in database.execute("SELECT run_name, config FROM configs")}
        logged = list(database.execute("SELECT run_name, metrics FROM metrics ORDER BY id"))
    last: dict[str, dict[str, float]] = {}
    for name, text in logged:
        values = {key: value for key, value in json.loads(text).items() if isinstance(value, (int, float))}
        last[name] = last.get(name, {}) | values
    rows = [{"run_id": name, **configs.get(name, {}), **values} for name, values in last.items()]
    return _numbers(pd.DataFrame(rows)), list(dict.fromkeys(key for values in last.values() for key in values))


def _numbers(table: pd.DataFrame) -> pd.DataFrame:
    """Trackers keep parameters as text: those that are numbers in all runs become numbers."""
    for name in table.select_dtypes(exclude="number"):
        numbers = pd.to_numeric(table[name], errors="coerce")
        if name != "run_id" and numbers.notna().sum() == table[name].notna().sum():
            table[name] = numbers
    return table


def _metrics(
    table: pd.DataFrame, columns: Sequence[str], settings: Sequence[str] | None, seed: str | None, scene: str | None
) -> list[str]:
    """The numbers that differ within groups of equal settings, those that measure no time first."""
    keys = _replicated(table, columns, seed, scene) if settings is None else [*settings, *filter(None, [scene])]
    numbers = [name for name in table.select_dtypes("number").columns if name in columns and name not in keys]
    differ = table.groupby(keys, dropna=False)[numbers].nunique().max() if keys else table[numbers].nunique()
    return sorted((name for name in numbers if differ[name] > 1), key=lambda name: bool(_TIME.fullmatch(str(name))))


def _replicated(table: pd.DataFrame, columns: Iterable[str], seed: str | None, scene: str | None) -> list[str]:
    """The columns that tell configurations apart: as few as leave each seed once in a group, those of fewest values
    first, and none that leaves most runs alone in their group."""
    keys = [scene] if scene else []
    results = [name for name in table.select_dtypes("number") if _RESULT.fullmatch(str(name))]
    counts = table[[name for name in columns if name not in results]].nunique(dropna=False)
    for name in counts[counts > 1].sort_values(kind="stable").index:
        if seed and not table.duplicated([*keys, seed]).any():
            break
        if table.groupby([*keys, name], dropna=False)[name].transform("size").median() >= 2:
            keys.append(name)
    return keys


def _ids(table: pd.DataFrame) -> list[str]:
    names = [name for name in table if re.fullmatch(r"(run_?)?(id|name)", str(name), re.IGNORECASE)]
    unique = next((name for name in names if table[name].is_unique), None)
    return [str(value) for value in (table[unique] if unique is not None else range(1, len(table) + 1))]


def _states(table: pd.DataFrame) -> list[str]:
    name = next((name for name in table if str(name).lower() in ("state", "status")), None)
    texts = ["finished"] * len(table) if name is None else table[name].astype(str).str.lower().tolist()
    return ["finished" if text in _FINISHED else "running" if text in _RUNNING else "failed" for text in texts]


def _plain(name: str) -> str:
    """A metric's name in a frame, where dots are for options."""
    return name.replace(".", "/")


def _declare(metrics: Sequence[str], settings: Sequence[str], scene: str | None) -> None:
    NAMED.update(settings)
    if scene:
        filters.ALIASES[scene] = "scene_name"
    for name in map(_plain, metrics):
        is_time = _TIME.fullmatch(name)
        better = metric_of(name).better or ("lower" if is_time else "higher")
        # taken out and put back, so that the first one is what verdicts are about
        known = METRICS.pop(name, Metric(name, name, better=better, kind="time" if is_time else "signal"))
        METRICS[name] = replace(known, on_request=False, kind=known.kind if known.kind != "loss" else "signal")


def _list(names: Iterable[str]) -> str:
    return ", ".join(map(str, names))
