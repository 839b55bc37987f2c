"""Runs as DataFrames, from the run store's files alone."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from qnerf.metrics import HEAD_PARAMETERS
from qnerf.records import filters, index, read_metrics
from qnerf.records.deletion import holds_runs
from qnerf.records.location import existing_store
from qnerf.records.schemas import LABELS

from . import foreign, packed

_HEADS = ("name", "mlp.layers", "mlp.width", "qiren.layers", "qiren.spectral", "qiren.qubits")
NEEDED = (
    "seed", "train.steps", "psnr", "ssim", *HEAD_PARAMETERS, "params.encoder", "params.total",
    "step_ms", "train_s", *(f"{head}.{key}" for head in ("density", "color") for key in _HEADS),
)  # fmt: skip
"""Columns that tables and figures read; in runs that lack them they are empty."""


def runs(
    store: str | Path | pd.DataFrame, filter: str | Mapping[str, Any] | None = None, **columns: Any
) -> pd.DataFrame:
    """One row a run: final metrics, parameter counts, timings, the flat configuration, state, `path`.

    See `qnerf.records.index.load`, which keeps an index: the next call reads only what has changed.

    store: a folder of runs, or a folder that `qnerf pack` made; or runs of another program, with `columns` as
    `foreign.read` takes them.
    filter: a text as `qnerf runs` takes it, "field=qcolor seed=0,1 psnr>25", or values by column,
    {"field": "qcolor", "seed": [0, 1]}; see `qnerf.records.filters`.

    Raises:
        ValueError: there are no runs, the filter matches none (the message lists the values there are), or it names an
            unknown column.
    """
    if foreign.is_foreign(store):
        frame = with_needed(foreign.read(store, **columns))
    elif given := [name for name, value in columns.items() if value is not None]:
        raise ValueError(f"{', '.join(given)}: a store of qnerf knows this; for tables of other programs alone")
    elif packed.is_packed(store):
        if holds_runs(Path(store)):
            raise ValueError(f"{store}: holds runs and also packed tables; expected one of both in a folder")
        frame = with_needed(packed.load(store))
    else:
        frame = index.load(store)
        if frame.empty:
            raise ValueError(f"{store}: no runs found; expected folders that hold a summary.parquet")
        frame = with_needed(frame)
    return frame if filter is None else filters.require(frame, filter)


def metrics(run: str | Path | pd.DataFrame, key: str | None = None) -> pd.DataFrame:
    """Columns step, time_s (seconds of training), key, value, in the order of logging; only rows of `key` if given.

    run: a run's folder; or the table from `runs`, which adds a column run_id.

    Raises:
        ValueError: a run has no metrics or damaged ones.
    """
    if isinstance(run, pd.DataFrame):
        pairs = zip(run["run_id"], run["path"], strict=True)
        return pd.concat([metrics(path, key).assign(run_id=name) for name, path in pairs], ignore_index=True)
    if packed.is_packed(Path(run).parent):
        raise ValueError(f"{run}: curves are not packed; they are in the store that the run was packed from")
    frame = read_metrics(existing_store(run))
    return frame if key is None else frame[frame["key"] == key].reset_index(drop=True)


def with_needed(frame: pd.DataFrame) -> pd.DataFrame:
    """The frame with the columns of `LABELS` and `NEEDED` that are missing, without values."""
    missing = {name: None if name in LABELS else np.nan for name in (*LABELS, *NEEDED) if name not in frame}
    return pd.concat([frame, pd.DataFrame(missing, index=frame.index)], axis=1)
