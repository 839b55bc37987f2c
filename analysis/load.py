"""Runs as DataFrames, from the run store's files alone."""

from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from qnerf.records import runs as folders
from qnerf.records import state


def runs(store: str | Path) -> pd.DataFrame:
    """One row a run: final metrics, parameter counts, timings, the flat configuration, and `path`.

    `state` is the true one: a run whose process died reads interrupted, whatever it last wrote. A run whose summary
    cannot be read is a row with its `path` and the state "damaged". ValueError where there is no run.
    """
    tables = list(_summaries(Path(store)))
    if not tables:
        raise ValueError(f"{store}: no runs found; expected folders that hold a summary.parquet")
    # An absent value has Arrow's null type, which gives way to the type that it has in other runs.
    frame = pa.concat_tables(tables, promote_options="permissive").to_pandas()
    path = frame.get("scene.path", pd.Series(None, index=frame.index, dtype=object))
    names = [Path(str(p)).name if p is not None and p == p else None for p in path]
    frame["scene_name"] = [name or scene for name, scene in zip(names, frame["scene"], strict=True)]
    return frame


def _summaries(store: Path) -> Iterator[pa.Table]:
    for folder in folders(store):
        try:
            table = pq.ParquetFile(folder / "summary.parquet").read()
            table = table.set_column(table.schema.get_field_index("state"), "state", pa.array([state(folder)]))
        except FileNotFoundError:
            continue
        except (pa.ArrowException, OSError):
            table = pa.table({"state": ["damaged"], "scene": [None]})
        yield table.append_column("path", pa.array([str(folder)]))


def metrics(run: str | Path, key: str | None = None) -> pd.DataFrame:
    """Columns step, time_s, key, value of a run; of one key alone if `key` is given."""
    filters = [("key", "==", key)] if key is not None else None
    return pd.read_parquet(Path(run) / "metrics", filters=filters)
