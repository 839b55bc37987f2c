"""Parquet files of one wide row, such as summary.parquet, from which the row is had without a Parquet reader.

Such a file is nearly all bookkeeping: parsing its footer takes ten times as long as parsing the same row from JSON, and
reading its columns fifty times. So the writer repeats the row in the footer's key-value metadata, as JSON that begins
with a checksum of all that lies before it: the columns, their names and types. Another program that changes the file
and keeps the entry, as pyarrow does, changes what the checksum is of, and the columns are read. The entry can be
missing, but not wrong.
"""

import json
import zlib
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

_MARK = b'["qnerf.row", "'
_DECODER = json.JSONDecoder()


def encode(table: pa.Table, before: bytes = b"", after: bytes = b"") -> bytes:
    """A Parquet file of one row, with something before and after its pages, as `stable.rewritten` wants it.

    Statistics of single values would only be another copy of them.
    """
    types = [str(kind) for kind in table.schema.types]
    values = [column[0].as_py() for column in table.columns]
    entry = json.dumps(["qnerf.row", f"{0:08x}", table.schema.names, types, values])
    sink = pa.BufferOutputStream()
    with pq.ParquetWriter(
        sink, table.schema, compression="none", use_dictionary=False, write_statistics=False, store_schema=False
    ) as writer:
        sink.write(before)  # the writer asks the sink where it is
        writer.write_table(table)
        sink.write(after)
        writer.add_key_value_metadata({"qnerf": entry})
    data = bytearray(sink.getvalue().to_pybytes())
    start = data.index(_MARK, _footer(data))
    checksum = start + len(_MARK)
    data[checksum : checksum + 8] = _checksum(data, start)
    return bytes(data)


def decode(data: bytes) -> tuple[list[str], list[str], list[Any]]:
    """Names, Arrow types and values of the columns in the one row.

    Raises:
        ValueError: damaged, or not one row. pyarrow's own errors are ValueErrors or OSErrors.
    """
    repeated = _repeated(data)
    if repeated is not None:
        return repeated
    file = pq.ParquetFile(pa.BufferReader(data))
    if file.metadata.num_rows != 1:
        raise ValueError(f"expected one row, got {file.metadata.num_rows:,}")
    table = file.read(use_threads=False)
    values = [column[0].as_py() for column in table.columns]
    return table.schema.names, [str(kind) for kind in table.schema.types], values


def _repeated(data: bytes) -> tuple[list[str], list[str], list[Any]] | None:
    """The footer's entry, if there is one and it belongs to this file."""
    start = data.find(_MARK, _footer(data))
    checksum = start + len(_MARK)
    if start < 0 or data[checksum : checksum + 8] != _checksum(data, start):
        return None
    try:
        (_, _, names, types, values), _ = _DECODER.raw_decode(data[start:].decode("latin-1"))
    except (ValueError, RecursionError):
        return None
    return names, types, values


def _footer(data: bytes | bytearray) -> int:
    """Where the footer begins."""
    return max(len(data) - 8 - int.from_bytes(data[-8:-4], "little"), 0)


def _checksum(data: bytes | bytearray, end: int) -> bytes:
    return b"%08x" % zlib.crc32(memoryview(data)[:end])
