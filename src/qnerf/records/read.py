"""Reading runs, live or finished, without any right to write. Nothing in a run's folder is executed."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import yaml  # type: ignore[import-untyped]

from qnerf.config.identity import plain
from qnerf.metrics import quality_metrics
from qnerf.records import owner
from qnerf.records.files import StoreError, one_line, read_bytes, read_json, reporting
from qnerf.records.location import RUN_ID
from qnerf.records.parquet import read_table, require_columns
from qnerf.records.schemas import METRICS_KINDS, METRICS_SCHEMA, TABLES, known_kind

STATES = ("running", "finished", "interrupted", "failed")
RUN_MARKERS = ("summary.parquet", "status.json", "config.yaml")
"""A folder with one of these files is a run."""

MAX_CONFIG_BYTES = 2**18
_PART = re.compile(r"part-([0-9]{5,9})\.parquet")


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


def checked_status(path: Path) -> dict[str, Any]:
    """A status.json.

    Raises:
        StoreError: it is damaged, or the folder is a copy of another run, which would count as a further seed.
    """
    with reporting(path, "read"):
        record = read_json(path)
    folder, original = path.parent, str(record.get("run_id"))
    if RUN_ID.fullmatch(original) and original != folder.name and (folder.parent / original / path.name).exists():
        raise StoreError(f"{folder}: is a copy of {original}, which is in this store, too")
    return record


def state(run_dir: str | Path, status: Mapping[str, Any] | None = None) -> str:
    """running | finished | interrupted | failed. A run counts as running only while its owner is alive.

    status: what `read_status` returned, if the caller has it already.
    """
    directory = Path(run_dir)
    status = read_status(directory) if status is None else status
    stored = status.get("state")
    if stored != "running":
        return stored if stored in STATES else "interrupted"
    if owner.is_alive(directory, status) and owner.is_owned(directory):
        return "running"
    # The owner was killed, or it has finished since status.json was read.
    now = read_status(directory).get("state")
    return now if now in STATES and now != "running" else "interrupted"


def read_config(run_dir: str | Path) -> dict[str, Any]:
    """The configuration. YAML aliases and everything but plain values are refused."""
    data = check_config(run_dir)
    try:
        return plain(yaml.load(data, Loader=_Loader))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise StoreError(f"{Path(run_dir) / 'config.yaml'}: not readable as YAML: {one_line(error)}") from error


def check_config(run_dir: str | Path) -> bytes:
    """config.yaml, if it is YAML with keys and values; StoreError otherwise. Takes a tenth of reading the values.

    Aliases are refused: a few nested ones can expand to more than fits in memory.
    """
    path = Path(run_dir) / "config.yaml"
    with reporting(path, "read"):
        data = read_bytes(path, MAX_CONFIG_BYTES)
    try:
        events = list(yaml.parse(data, Loader=_Loader))
    except (yaml.YAMLError, ValueError) as error:
        raise StoreError(f"{path}: not readable as YAML: {one_line(error)}") from error
    if not any(isinstance(event, yaml.MappingStartEvent) for event in events[2:3]):
        raise StoreError(f"{path}: not readable as YAML: expected keys and values")
    if any(isinstance(event, yaml.AliasEvent) for event in events):
        raise StoreError(f"{path}: not readable as YAML: an alias is not allowed")
    return data


_Safe: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # PyYAML can be built without its C library


class _Loader(_Safe):
    """Plain values only, dates as text."""

    yaml_implicit_resolvers = {  # noqa: RUF012
        first: [(tag, pattern) for tag, pattern in resolvers if not tag.endswith(":timestamp")]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }


def read_summary(run_dir: str | Path) -> dict[str, Any]:
    """summary.parquet as plain values. Its `state` is the one last written; `state(run_dir)` is the true one."""
    path = Path(run_dir) / "summary.parquet"
    rows = read_table(path, known_kind).to_pylist()
    if len(rows) != 1:
        raise StoreError(f"{path}: damaged: expected one row, got {len(rows):,}")
    row: dict[str, Any] = rows[0]
    return row


def metric_parts(run_dir: str | Path) -> dict[int, Path]:
    """Number -> file of metrics/, in ascending order. Other names, such as copies of a sync program, are left out."""
    folder = Path(run_dir) / "metrics"
    with reporting(folder, "read"):
        found = {int(match[1]): path for path in folder.iterdir() if (match := _PART.fullmatch(path.name))}
    return {number: found[number] for number in sorted(found) if found[number].name == part_name(number)}


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
