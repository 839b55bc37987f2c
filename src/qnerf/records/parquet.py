"""Parquet files with columns of four kinds: whole numbers, numbers, booleans, text."""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from qnerf.records.files import MAX_TABLE_BYTES, StoreError, one_line, read_bytes, reporting

TYPES = {"int": pa.int64(), "float": pa.float64(), "bool": pa.bool_(), "text": pa.string()}
"""Kind of a column -> its Arrow type in every file of a store."""

_NAMES = {"int": "whole numbers", "float": "numbers", "bool": "true or false", "text": "text"}


@contextlib.contextmanager
def reading(label: object) -> Iterator[None]:
    """Turns every error of a reader of damaged data into the StoreError "LABEL: damaged: REASON"."""
    try:
        yield
    except StoreError:
        raise
    except Exception as error:  # pyarrow and Pillow raise errors of many kinds for damaged files
        raise StoreError(f"{label}: damaged: {one_line(error)}") from error


def encode(table: pa.Table) -> bytes:
    """A Parquet file. One row is not compressed: each of its values would be, by itself."""
    sink = pa.BufferOutputStream()
    many = table.num_rows > 1
    compression = "zstd" if many else "none"
    pq.write_table(table, sink, compression=compression, use_dictionary=many, write_statistics=many, store_schema=False)
    return sink.getvalue().to_pybytes()


Kinds = Callable[[str], str | None]
"""Name of a column -> its declared kind; None: it keeps its own."""


def read_table(path: Path, kinds: Kinds = lambda name: None) -> pa.Table:
    """A Parquet file in memory, see `typed`; StoreError if it is absent or damaged."""
    with reporting(path, "read"):
        data = read_bytes(path, MAX_TABLE_BYTES)
    with reading(path):
        # Not pq.read_table: if its threads still hold Python's buffer when the interpreter ends, the process aborts.
        table = pq.ParquetFile(pa.BufferReader(data)).read(use_threads=False)
        return typed(table, kinds)


def typed(table: pa.Table, kinds: Kinds) -> pa.Table:
    """The table with the types of `TYPES`: of the declared kind, else of the column's own. Others become text.

    Raises:
        ValueError: a column occurs twice, or its values are of another kind.
    """
    target = _target(table.schema, kinds)
    result = table if table.schema.equals(target) else table.cast(target)
    result.validate(full=True)  # text is UTF-8
    return result


def require_columns(table: pa.Table, kinds: Mapping[str, str], label: object) -> pa.Table:
    """The table, typed, if it has all columns in `kinds`; StoreError otherwise."""
    with reading(label):
        if missing := [name for name in kinds if name not in table.schema.names]:
            raise ValueError(f"expected a column {missing[0]}")
        return typed(table, kinds.get)


def kind_of(kind: pa.DataType) -> str:
    """The kind that holds values of an Arrow type; `none` for the type of nulls."""
    if pa.types.is_null(kind):
        return "none"
    if pa.types.is_boolean(kind):
        return "bool"
    if pa.types.is_integer(kind):
        return "int"
    return "float" if pa.types.is_floating(kind) else "text"


@lru_cache(maxsize=256)
def _target(schema: pa.Schema, kinds: Kinds) -> pa.Schema:
    """The schema after `typed`. Runs with the same columns, of which a store has many, need it once."""
    names = schema.names
    if len(set(names)) < len(names):
        doubled = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"expected one column {doubled}, got {names.count(doubled)}")
    return pa.schema([(field.name, _type(field, kinds(field.name))) for field in schema])


def _type(field: pa.Field, wanted: str | None) -> pa.DataType:
    kind = kind_of(field.type)
    wanted = wanted or kind
    if wanted == "none":
        return field.type
    if kind not in ("none", wanted) and wanted != "text" and {kind, wanted} != {"int", "float"}:
        raise ValueError(f"{field.name}: expected {_NAMES[wanted]}, got {field.type}")
    return TYPES[wanted]
