"""Reading runs, live or finished, without any right to write.

A folder may come from anybody: nothing in it is executed, links in it are not followed, and no file is read or unpacked
beyond what a run writes.
"""

import os
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import yaml  # type: ignore[import-untyped]

from qnerf.config.compatibility import today, upgrade_config
from qnerf.records import owner
from qnerf.records.files import StoreError, read_bytes, read_record, reporting
from qnerf.records.schemas import METRICS

STATES = ("running", "finished", "interrupted", "failed")
MOST_CONFIG_BYTES = 2**18
MOST_TABLE_BYTES = 2**28
MOST_ROWS = 2**22  # of one file; run-length encoding packs more than fits into memory into a few bytes


def runs(root: str | Path) -> list[Path]:
    """Folders of the runs in a store, sorted by name; empty when there is no store yet."""
    root = Path(root)
    with reporting(root, "read"):
        return (
            sorted(path for path in root.iterdir() if not path.name.startswith(".") and path.is_dir())
            if (root.is_dir())
            else []
        )


def read_status(run_dir: str | Path) -> dict[str, Any]:
    """status.json; empty when it is absent or damaged."""
    try:
        return read_record(Path(run_dir) / "status.json")
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return {}
    except OSError as error:
        raise StoreError(f"{run_dir}: cannot read status.json: {error.strerror or error}") from error


def state(run_dir: str | Path, status: dict[str, Any] | None = None) -> str:
    """running | finished | interrupted | failed. Derived: a run is running only while its owner is alive.

    `status` saves reading status.json again.
    """
    directory = Path(run_dir)
    status = read_status(directory) if status is None else status
    stored = status.get("state")
    if stored != "running":
        return stored if stored in STATES else "interrupted"
    if _is_owned(directory, status):
        return "running"
    # Nobody owns it: it was killed, or it has ended since status.json was read.
    now = read_status(directory).get("state")
    return now if now in STATES and now != "running" else "interrupted"


def _is_owned(directory: Path, status: dict[str, Any]) -> bool:
    if not owner.alive(status, owner.moment(status.get("heartbeat"))):
        return False
    try:
        _, record = owner.newest(directory)
    except OSError:
        return False
    return record is not None and not record.get("released")


def read_config(run_dir: str | Path) -> dict[str, Any]:
    """The resolved configuration under today's names; nothing in the file is executed or repeated by reference."""
    path = Path(run_dir) / "config.yaml"
    with reporting(path, "read"):
        data = read_bytes(path, MOST_CONFIG_BYTES)
    try:
        config = yaml.load(data, Loader=_Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise StoreError(f"{path}: not readable as YAML: {' '.join(str(error).split())}") from error
    if not isinstance(config, dict):
        raise StoreError(f"{path}: expected keys and values, got {type(config).__name__}")
    return upgrade_config(config)


class _Loader(yaml.SafeLoader):
    """Plain values only, dates as text, and no aliases: a few nested ones stand for more items than fit into memory."""

    yaml_implicit_resolvers = {  # noqa: RUF012
        first: [(tag, pattern) for tag, pattern in resolvers if not tag.endswith(":timestamp")]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            raise yaml.composer.ComposerError(None, None, f"alias *{event.anchor} is not allowed", event.start_mark)
        return super().compose_node(parent, index)


def read_summary(run_dir: str | Path) -> dict[str, Any]:
    """summary.parquet as plain values. `state` is the one last written; `state(run_dir)` tells the true one."""
    path = Path(run_dir) / "summary.parquet"
    rows: list[dict[str, Any]] = read_table(path).to_pylist()
    if len(rows) != 1:
        raise StoreError(f"{path}: expected one row, got {len(rows)}")
    return {today(name): value for name, value in rows[0].items()}


def read_metrics(run_dir: str | Path) -> pd.DataFrame:
    """Columns step, time_s, key, value, in the order of logging; StoreError names a damaged part."""
    folder = Path(run_dir) / "metrics"
    if folder.is_symlink():
        raise StoreError(f"{folder}: is a link; the files of a run are not read or written through links")
    with reporting(folder, "read"):
        names = sorted(entry.name for entry in os.scandir(folder) if entry.name.startswith("part-"))
    return pa.concat_tables([METRICS.empty_table(), *(read_part(folder / name) for name in names)]).to_pandas()


def read_part(path: Path) -> pa.Table:
    """One file of metrics/, with the columns and types of `tables.METRICS`."""
    table = read_table(path)
    if table.schema.names != METRICS.names:
        raise StoreError(f"{path}: expected columns {METRICS.names}, got {table.schema.names}")
    try:
        return table.cast(METRICS)
    except pa.ArrowException as error:
        raise StoreError(f"{path}: damaged: {' '.join(str(error).split())}") from error


def read_table(path: Path) -> pa.Table:
    """A Parquet file in memory; StoreError when it is absent or damaged."""
    with reporting(path, "read"):
        data = read_bytes(path, MOST_TABLE_BYTES)
    try:
        # Not pq.read_table: its threads may still hold Python's buffer when the interpreter ends, which aborts.
        file = pq.ParquetFile(pa.BufferReader(data))
        if file.metadata.num_rows > MOST_ROWS:
            raise StoreError(f"{path}: has {file.metadata.num_rows:,} rows; expected at most {MOST_ROWS:,}")
        return file.read(use_threads=False)
    except (pa.ArrowException, OSError) as error:
        raise StoreError(f"{path}: damaged: {' '.join(str(error).split())}") from error
