"""Reading runs, live or finished, without any right to write. Nothing in a run's folder is executed."""

import re
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import yaml  # type: ignore[import-untyped]

from qnerf.config.identity import plain
from qnerf.metrics import quality_metrics
from qnerf.records import owner
from qnerf.records.files import StoreError, one_line, read_json, reporting
from qnerf.records.parquet import decoded, read_table, require_columns, typed
from qnerf.records.schemas import METRICS_KINDS, METRICS_SCHEMA, TABLES, known_kind

ENDED = ("finished", "interrupted", "failed")
"""States of a run that nobody writes."""

RUN_MARKERS = ("summary.parquet", "status.json", "config.yaml")
"""A folder with one of these files is a run."""

_PART = re.compile(r"part-([0-9]{5,})\.parquet")


def runs(root: str | Path) -> list[Path]:
    """Folders of the runs in a store, sorted by name; empty if there is no store yet."""
    root = Path(root)
    with reporting(root, "read"):
        if not root.is_dir():
            return []
        return sorted(path for path in root.iterdir() if not path.name.startswith(".") and path.is_dir())


def read_status(run_dir: str | Path) -> dict[str, Any]:
    """status.json; empty if it is absent or damaged."""
    path = Path(run_dir) / "status.json"
    with reporting(path, "read"):
        try:
            return read_json(path)
        except (FileNotFoundError, NotADirectoryError, ValueError):
            return {}


def checked_status(run_dir: str | Path) -> dict[str, Any]:
    """status.json.

    Raises:
        StoreError: it is absent or damaged, or the folder is a copy of another run, which would count as another seed.
    """
    folder = Path(run_dir)
    path = folder / "status.json"
    with reporting(path, "read"):
        record = read_json(path)
    original = str(record.get("run_id", folder.name))
    if original != folder.name and (folder.with_name(original) / path.name).exists():
        raise StoreError(f"{folder}: is a copy of {original}, which is in this store, too")
    return record


def state(run_dir: str | Path, status: Mapping[str, Any] | None = None) -> str:
    """running | finished | interrupted | failed. A run counts as running only while its owner is alive.

    status: what `read_status` returned, if the caller has it already.
    """
    directory = Path(run_dir)
    stored = (read_status(directory) if status is None else status).get("state")
    if stored == "running":
        if owner.living(directory) is not None:
            return "running"
        # The owner was killed, or it has finished since status.json was read.
        stored = read_status(directory).get("state")
    return stored if stored in ENDED else "interrupted"


def read_config(run_dir: str | Path) -> dict[str, Any]:
    """The configuration; StoreError if it is absent, or holds anything else than plain values."""
    path = Path(run_dir) / "config.yaml"
    with reporting(path, "read"):
        data = path.read_bytes()
    try:
        config = plain(yaml.load(data, Loader=_Loader))
    except (yaml.YAMLError, ValueError) as error:
        raise StoreError(f"{path}: not readable as YAML: {one_line(error)}") from error
    if not isinstance(config, dict):
        raise StoreError(f"{path}: not readable as YAML: expected keys and values")
    return config


_Safe: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # PyYAML can be built without its C library


class _Loader(_Safe):
    """Plain values only, dates as text."""

    yaml_implicit_resolvers = {  # noqa: RUF012
        first: [(tag, pattern) for tag, pattern in resolvers if not tag.endswith(":timestamp")]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }


def read_summary(run_dir: str | Path) -> dict[str, Any]:
    """summary.parquet as plain values. Its `state` is the one last written; `state(run_dir)` is the true one.

    status.json holds the same row, which is used while the file is the one that it was written with: to decode a
    hundred columns takes ten times as long.
    """
    path = Path(run_dir) / "summary.parquet"
    with reporting(path, "read"):
        data = path.read_bytes()
    copy = read_status(run_dir).get("summary")
    if isinstance(copy, dict) and copy.get("crc32") == zlib.crc32(data) and isinstance(copy.get("row"), dict):
        return dict(copy["row"])
    return _row(decoded(data, known_kind, path), path)


def summary_copy(table: pa.Table, data: bytes) -> dict[str, Any]:
    """What status.json holds of summary.parquet, the file `data` of the table."""
    return {"crc32": zlib.crc32(data), "row": _row(typed(table, known_kind), "summary")}


def _row(table: pa.Table, label: object) -> dict[str, Any]:
    rows = table.to_pylist()
    if len(rows) != 1:
        raise StoreError(f"{label}: damaged: expected one row, got {len(rows):,}")
    row: dict[str, Any] = rows[0]
    return row


def metric_parts(run_dir: str | Path) -> dict[int, Path]:
    """Number -> file of metrics/, in ascending order. Other names, such as copies of a sync program, are left out."""
    folder = Path(run_dir) / "metrics"
    with reporting(folder, "read"):
        return {int(match[1]): path for path in sorted(folder.iterdir()) if (match := _PART.fullmatch(path.name))}


def part_name(number: int) -> str:
    """
    >>> part_name(3)
    'part-00003.parquet'
    """
    return f"part-{number:05d}.parquet"


def read_metrics(run_dir: str | Path) -> pd.DataFrame:
    """Columns step, time_s, key, value, in the order of logging; StoreError names a damaged part."""
    parts = metric_parts(run_dir).values()
    return pa.concat_tables([METRICS_SCHEMA.empty_table(), *map(read_part, parts)]).to_pandas()


def read_part(path: Path) -> pa.Table:
    """One file of metrics/, with the columns and types of `schemas.METRICS_SCHEMA` and a value in every cell."""
    table = read_table(path, METRICS_KINDS.get)
    if not table.schema.equals(METRICS_SCHEMA):
        raise StoreError(f"{path}: damaged: expected columns {METRICS_SCHEMA.names}, got {table.schema.names}")
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
    """The table `<name>.parquet` that `qnerf probe` left in a run's folder.

    Raises:
        StoreError: the file is absent or damaged, or lacks one of the columns of `schemas.TABLES`.
    """
    path = Path(run_dir) / f"{name}.parquet"
    return checked_table(read_table(path), name, path).to_pandas()


def checked_table(table: pa.Table, name: str, label: object) -> pa.Table:
    """The table with the columns of `schemas.TABLES`, and image metrics as numbers; StoreError if it differs."""
    metrics = {item.key: "float" for item in quality_metrics() if item.key in table.schema.names}
    return require_columns(table, metrics | TABLES.get(name, {}), label)
