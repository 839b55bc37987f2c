"""Reading runs, live or finished, without any right to write.

A folder may come from anybody: nothing in it is executed, no link in it is followed, and no file is read or unpacked
beyond the size of those that a run writes.
"""

from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import yaml  # type: ignore[import-untyped]

from qnerf.config.compatibility import today, upgrade_config
from qnerf.records import owner
from qnerf.records.files import StoreError, folders_in, one_line, read_bytes, read_json, reporting
from qnerf.records.numbered import PARTS
from qnerf.records.schemas import METRICS_SCHEMA

STATES = ("running", "finished", "interrupted", "failed")
RUN_MARKERS = ("summary.parquet", "status.json", "config.yaml")
"""A folder with one of these files is a run."""

MAX_CONFIG_BYTES = 2**18
MAX_TABLE_BYTES = 2**28
MAX_TABLE_ROWS = 2**22  # per file; run-length encoding packs more rows than fit into memory into a few bytes


def runs(root: str | Path) -> list[Path]:
    """Folders of the runs in a store, sorted by name; empty if there is no store yet."""
    root = Path(root)
    with reporting(root, "read"):
        if not root.is_dir():
            return []
        return [path for path in folders_in(root, root=root) if not path.name.startswith(".")]


def read_status(run_dir: str | Path) -> dict[str, Any]:
    """status.json; empty if it is absent or damaged."""
    path = Path(run_dir) / "status.json"
    with reporting(path, "read"):
        try:
            return read_json(path)
        except (FileNotFoundError, NotADirectoryError, ValueError):
            return {}


def state(run_dir: str | Path, status: dict[str, Any] | None = None) -> str:
    """running | finished | interrupted | failed. A run counts as running only while its owner is alive.

    status: what `read_status` returned, if the caller has it already.
    """
    directory = Path(run_dir)
    status = read_status(directory) if status is None else status
    stored = status.get("state")
    if stored != "running":
        return stored if stored in STATES else "interrupted"
    if _has_living_owner(directory, status):
        return "running"
    # The owner was killed, or it has finished since status.json was read.
    now = read_status(directory).get("state")
    return now if now in STATES and now != "running" else "interrupted"


def _has_living_owner(directory: Path, status: dict[str, Any]) -> bool:
    if not owner.is_alive(status, owner.unix_time(status.get("heartbeat"))):
        return False
    try:
        _, record = owner.latest(directory)
    except OSError:
        return False
    return record is not None and not record.get("released")


def read_config(run_dir: str | Path) -> dict[str, Any]:
    """The resolved configuration under today's names. YAML aliases and everything but plain values are refused."""
    path = Path(run_dir) / "config.yaml"
    with reporting(path, "read"):
        data = read_bytes(path, MAX_CONFIG_BYTES)
    try:
        config = yaml.load(data, Loader=_Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise StoreError(f"{path}: not readable as YAML: {one_line(error)}") from error
    if not isinstance(config, dict):
        raise StoreError(f"{path}: expected keys and values, got {type(config).__name__}")
    return upgrade_config(config)


class _Loader(yaml.SafeLoader):
    """Plain values only, dates as text, and no aliases: a few nested aliases can expand to more than fits in memory."""

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
    """summary.parquet as plain values. Its `state` is the one last written; `state(run_dir)` is the true one."""
    path = Path(run_dir) / "summary.parquet"
    rows: list[dict[str, Any]] = read_table(path).to_pylist()
    if len(rows) != 1:
        raise StoreError(f"{path}: expected one row, got {len(rows)}")
    return {today(name): value for name, value in rows[0].items()}


def read_metrics(run_dir: str | Path) -> pd.DataFrame:
    """Columns step, time_s, key, value, in the order of logging; StoreError names a damaged part."""
    folder = Path(run_dir) / "metrics"
    with reporting(folder, "read"):
        parts = PARTS.in_folder(folder).values()
    return pa.concat_tables([METRICS_SCHEMA.empty_table(), *map(read_part, parts)]).to_pandas()


def read_part(path: Path) -> pa.Table:
    """One file of metrics/, with the columns and types of `schemas.METRICS_SCHEMA`."""
    table = read_table(path)
    if table.schema.names != METRICS_SCHEMA.names:
        raise StoreError(f"{path}: expected columns {METRICS_SCHEMA.names}, got {table.schema.names}")
    try:
        return table.cast(METRICS_SCHEMA)
    except pa.ArrowException as error:
        raise StoreError(f"{path}: damaged: {one_line(error)}") from error


def read_table_bytes(path: Path) -> bytes:
    """A Parquet file as it is; StoreError if it is absent or too large."""
    with reporting(path, "read"):
        return read_bytes(path, MAX_TABLE_BYTES)


def read_table(path: Path) -> pa.Table:
    """A Parquet file in memory; StoreError if it is absent or damaged."""
    data = read_table_bytes(path)
    try:
        # Not pq.read_table: if its threads still hold Python's buffer when the interpreter ends, the process aborts.
        file = pq.ParquetFile(pa.BufferReader(data))
        if file.metadata.num_rows > MAX_TABLE_ROWS:
            raise StoreError(f"{path}: has {file.metadata.num_rows:,} rows; expected at most {MAX_TABLE_ROWS:,}")
        return file.read(use_threads=False)
    except (pa.ArrowException, OSError) as error:
        raise StoreError(f"{path}: damaged: {one_line(error)}") from error
