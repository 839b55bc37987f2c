"""Reading runs, live or finished, without any right to write.

A folder may come from anybody: nothing in it is executed, no link in it is followed, and no file is read or unpacked
beyond the size of those that a run writes.
"""

from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import yaml  # type: ignore[import-untyped]

from qnerf.config.compatibility import upgrade_config
from qnerf.metrics import quality_metrics
from qnerf.records import owner, summary_row
from qnerf.records.files import StoreError, folders_in, one_line, read_bytes, read_json, reporting
from qnerf.records.numbered import PARTS
from qnerf.records.parquet import MAX_ROWS, parse_table, reading, with_kinds
from qnerf.records.plain_values import check_plain
from qnerf.records.schemas import METRICS_KINDS, METRICS_SCHEMA, TABLES, plain_row

STATES = ("running", "finished", "interrupted", "failed")
RUN_MARKERS = ("summary.parquet", "status.json", "config.yaml")
"""A folder with one of these files is a run."""

MAX_CONFIG_BYTES = 2**18
MAX_TABLE_BYTES = 2**28
MAX_VIEWS = 2**14  # rows of eval.parquet, which `qnerf show` lists


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
        check_plain(config)
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
    data = read_table_bytes(path)
    with reading(path):
        return plain_row(*summary_row.decode(data, path))


def read_metrics(run_dir: str | Path) -> pd.DataFrame:
    """Columns step, time_s, key, value, in the order of logging; StoreError names a damaged part."""
    folder = Path(run_dir) / "metrics"
    with reporting(folder, "read"):
        parts = PARTS.in_folder(folder).values()
    return pa.concat_tables([METRICS_SCHEMA.empty_table(), *map(read_part, parts)]).to_pandas()


def read_part(path: Path) -> pa.Table:
    """One file of metrics/, with the columns and types of `schemas.METRICS_SCHEMA` and a value in every cell."""
    table = read_table(path)
    if table.schema.names != METRICS_SCHEMA.names:
        raise StoreError(f"{path}: expected columns {METRICS_SCHEMA.names}, got {table.schema.names}")
    table = with_kinds(table, METRICS_KINDS, path).cast(METRICS_SCHEMA)
    if any(column.null_count for column in table.columns):
        raise StoreError(f"{path}: damaged: has rows without a step, time, key or value")
    return table


def read_evaluation(run_dir: str | Path) -> pd.DataFrame:
    """eval.parquet, one row per held-out image: `image`, `step`, and metrics as numbers.

    Raises:
        StoreError: the file is absent or damaged, or a metric is no number.
    """
    return read_probe(run_dir, "eval")


def read_probe(run_dir: str | Path, name: str) -> pd.DataFrame:
    """The table `<name>.parquet` that `qnerf probe` left in a run's folder, see `schemas.TABLES`.

    Raises:
        StoreError: the file is absent or damaged, or lacks one of the columns.
    """
    path = Path(run_dir) / f"{name}.parquet"
    return checked_table(read_table(path, max_rows=MAX_VIEWS if name == "eval" else MAX_ROWS), name, path).to_pandas()


def checked_table(table: pa.Table, name: str, label: object) -> pa.Table:
    """The table with the columns of `schemas.TABLES[name]`, and image metrics as numbers; StoreError if it differs."""
    metrics = {item.key: "float" for item in quality_metrics() if item.key in table.schema.names}
    return with_kinds(table, metrics | TABLES[name], label)


def read_table_bytes(path: Path, *, root: Path | None = None) -> bytes:
    """A Parquet file as it is; StoreError if it is absent or too large. root: as in `files`."""
    with reporting(path, "read"):
        return read_bytes(path, MAX_TABLE_BYTES, root=root)


def read_table(path: Path, *, max_rows: int = MAX_ROWS, root: Path | None = None) -> pa.Table:
    """A Parquet file in memory; StoreError if it is absent or damaged, or would unpack to more than a run writes.

    root: as in `files`.
    """
    return parse_table(read_table_bytes(path, root=root), path, max_rows=max_rows)
