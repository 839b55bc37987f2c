"""Parquet files whose next version leaves the pages of the one before where they were.

pandas (for a single file) and DuckDB open a file twice: for its footer, which says where the pages lie, and then for
the pages. Where it was replaced in between they would look for the pages of the old version in the new one. So those
are still there, at the same place: such a reader gets the old version whole.
"""

import io
from collections.abc import Callable

import pyarrow as pa
import pyarrow.parquet as pq

MOST_OLD_BYTES = 2**16
_MAGIC = b"PAR1"


def appended(old: bytes, table: pa.Table) -> bytes:
    """The file `old` and the rows of `table` after its own, as a further row group; all earlier versions stay in it."""
    body = old[: _footer_start(old)]
    data = encode(table, before=body[len(_MAGIC) :])
    added, metadata = _metadata(data), _metadata(old)
    if not metadata.num_rows:
        return data
    metadata.append_row_groups(added)
    return data[: _footer_start(data)] + _footer(metadata)


def rewritten(old: bytes, made: Callable[[bytes, bytes], bytes]) -> bytes:
    """The file `made(before, after)` in the place of the file `old`, whose pages are what lies before or after the new.

    All earlier versions stay in it up to `MOST_OLD_BYTES`. Beyond them the one before does, and the new pages go into
    the room of older ones if they fit there: the file does not grow for ever.
    """
    body = old[len(_MAGIC) : _footer_start(old)]
    if len(body) <= MOST_OLD_BYTES:
        return made(body, b"")
    first, end = _page_range(old)
    room = first - _footer_start(made(b"", b""))
    if room >= 0:
        return made(b"", bytes(room) + old[first:end])
    return made(bytes(first - len(_MAGIC)) + old[first:end], b"")


def encode(table: pa.Table, before: bytes = b"", after: bytes = b"") -> bytes:
    """A Parquet file with something before and after its pages. Text is a dictionary and indices."""
    text = [
        field.name for field in table.schema if pa.types.is_string(field.type) or pa.types.is_dictionary(field.type)
    ]
    sink = pa.BufferOutputStream()
    # Without the stored Arrow schema text reads back as text, although it is encoded as a dictionary.
    with pq.ParquetWriter(
        sink, table.schema, compression="zstd", compression_level=1, use_dictionary=text, store_schema=False
    ) as writer:
        sink.write(before)  # the writer asks the sink where it is
        writer.write_table(table)
        sink.write(after)
    return sink.getvalue().to_pybytes()


def _metadata(data: bytes) -> pq.FileMetaData:
    return pq.read_metadata(pa.BufferReader(data))


def _footer(metadata: pq.FileMetaData) -> bytes:
    sink = io.BytesIO()
    metadata.write_metadata_file(sink)
    return sink.getvalue()[len(_MAGIC) :]


def _footer_start(data: bytes) -> int:
    return len(data) - 8 - int.from_bytes(data[-8:-4], "little")


def _page_range(data: bytes) -> tuple[int, int]:
    """Where the pages that the footer names begin and end; what older versions left around them does not count."""
    metadata = _metadata(data)
    first, end = _footer_start(data), len(_MAGIC)
    for group in map(metadata.row_group, range(metadata.num_row_groups)):
        for column in map(group.column, range(group.num_columns if group.num_rows else 0)):
            start = column.dictionary_page_offset or column.data_page_offset
            first, end = min(first, start), max(end, start + column.total_compressed_size)
    return min(first, end), end
