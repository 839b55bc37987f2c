"""Parquet files with columns of four kinds: whole numbers, numbers, booleans, text."""

from collections.abc import Callable, Mapping
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from qnerf.records.files import reading, reporting

TYPES = {"int": pa.int64(), "float": pa.float64(), "bool": pa.bool_(), "text": pa.string()}
"""Kind of a column -> its Arrow type in every file of a store."""


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
        data = path.read_bytes()
    return decoded(data, kinds, path)


def decoded(data: bytes, kinds: Kinds, label: object) -> pa.Table:
    """As `read_table`, of a file's bytes."""
    with reading(label):
        # Not pq.read_table: if its threads still hold Python's buffer when the interpreter ends, the process aborts.
        table = pq.ParquetFile(pa.BufferReader(data)).read(use_threads=False)
        return typed(table, kinds)


def typed(table: pa.Table, kinds: Kinds) -> pa.Table:
    """The table with the types of `TYPES`: of the declared kind, else of the column's own. Others become text.

    Raises:
        ValueError: values do not fit their kind.
    """
    target = pa.schema([(field.name, _type(field, kinds(field.name))) for field in table.schema])
    result = table if table.schema.equals(target) else table.cast(target)
    result.validate(full=True)  # text is UTF-8
    return result


def require_columns(table: pa.Table, kinds: Mapping[str, str], label: object) -> pa.Table:
    """The table, typed, if it has all columns in `kinds`; StoreError otherwise."""
    with reading(label):
        if missing := [name for name in kinds if name not in table.schema.names]:
            raise ValueError(f"expected a column {missing[0]}")
        return typed(table, kinds.get)


def _type(field: pa.Field, kind: str | None) -> pa.DataType:
    if kind is not None:
        return TYPES[kind]
    if pa.types.is_null(field.type) or pa.types.is_boolean(field.type):
        return field.type
    if pa.types.is_integer(field.type):
        return TYPES["int"]
    return TYPES["float" if pa.types.is_floating(field.type) else "text"]
