"""Parquet files with one wide row, such as summary.parquet, that can be read without a Parquet reader.

Parsing the footer of such a file takes ten times as long as parsing the same row from JSON, and reading its columns
fifty times. So the writer repeats the row as JSON in the footer's key-value metadata. The JSON begins with a checksum
of everything before it: the columns, their names and their types. If another program changes the file and copies the
metadata, as pyarrow does, the checksum no longer fits and the columns are read instead.
"""

import json
import zlib
from typing import Any

import pyarrow as pa

from qnerf.records.files import StoreError
from qnerf.records.live_parquet import footer_start, write
from qnerf.records.parquet import open_table, read_columns

_MARKER = b'["qnerf.row", "'
_DECODER = json.JSONDecoder()


def encode(table: pa.Table, before: bytes = b"", after: bytes = b"") -> bytes:
    """A Parquet file of one row, with `before` and `after` around its pages (see `live_parquet.rewritten`)."""
    types = [str(kind) for kind in table.schema.types]
    values = [column[0].as_py() for column in table.columns]
    repeated = json.dumps(["qnerf.row", f"{0:08x}", table.schema.names, types, values])
    # Statistics would only be another copy of the values.
    options: dict[str, Any] = {"compression": "none", "use_dictionary": False, "write_statistics": False}
    data = bytearray(write(table, before, after, {"qnerf": repeated}, **options))
    start = data.index(_MARKER, footer_start(data))
    position = start + len(_MARKER)
    data[position : position + 8] = _checksum(data, start)
    return bytes(data)


def decode(data: bytes, label: object = "summary.parquet") -> tuple[list[str], list[str], list[Any]]:
    """Names, Arrow types and values of the columns of the one row.

    label: the path or URL for error messages.

    Raises:
        StoreError: damaged, or not one row.
    """
    repeated = _repeated_row(data)
    if repeated is not None:
        return repeated
    file = open_table(data, label)
    if file.metadata.num_rows != 1:
        raise StoreError(f"{label}: expected one row, got {file.metadata.num_rows:,}")
    table = read_columns(file, label)
    values = [column[0].as_py() for column in table.columns]
    return table.schema.names, [str(kind) for kind in table.schema.types], values


def _repeated_row(data: bytes) -> tuple[list[str], list[str], list[Any]] | None:
    """The row from the footer; None if there is none or its checksum does not fit."""
    start = data.find(_MARKER, footer_start(data))
    position = start + len(_MARKER)
    if start < 0 or data[position : position + 8] != _checksum(data, start):
        return None
    try:
        (_, _, names, types, values), _ = _DECODER.raw_decode(data[start:].decode("latin-1"))
    except (ValueError, RecursionError):
        return None
    return names, types, values


def _checksum(data: bytes | bytearray, end: int) -> bytes:
    return b"%08x" % zlib.crc32(memoryview(data)[:end])
