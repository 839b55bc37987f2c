"""Parquet files that can be replaced while somebody reads them.

pandas (for a single file) and DuckDB open a file twice: first for its footer, which says where the pages lie, then for
the pages. If the file is replaced in between, they look for the old pages in the new file. Therefore every new version
keeps the pages of the version before at the same place, and such a reader gets the old version whole.
"""

import io
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from qnerf.records.files import StoreError
from qnerf.records.parquet import open_table, parse_table, reading

MAX_OLD_BYTES = 2**16
_MAGIC = b"PAR1"
_OLD = "the version before"


def appended(old: bytes, table: pa.Table) -> bytes:
    """The file `old` with the rows of `table` after its own, as another row group. It contains all earlier versions.

    Raises:
        StoreError: `old` is damaged.
    """
    body = old[: footer_start(old)]
    new = encode(table, before=body[len(_MAGIC) :])
    metadata, added = open_table(old, _OLD).metadata, _metadata(new)
    if not metadata.num_rows:
        return new
    if not metadata.schema.equals(added.schema):  # another program wrote it
        with reading(_OLD):
            before = parse_table(old, _OLD).cast(table.schema)
        return rewritten(old, partial(encode, pa.concat_tables([before, table])))
    metadata.append_row_groups(added)
    footer = io.BytesIO()
    metadata.write_metadata_file(footer)
    return new[: footer_start(new)] + footer.getvalue()[len(_MAGIC) :]


def rewritten(old: bytes, encode_between: Callable[[bytes, bytes], bytes]) -> bytes:
    """The file `encode_between(before, after)`, where the pages of the file `old` are in `before` or `after`.

    It contains all earlier versions as long as they have at most `MAX_OLD_BYTES`. Beyond that it contains only the
    last one, and the new pages go where older ones were if they fit, so that the file does not grow for ever. A damaged
    one is not kept: nobody can read it.
    """
    body = old[len(_MAGIC) : footer_start(old)]
    if len(body) <= MAX_OLD_BYTES:
        return encode_between(body, b"")
    try:
        first, end = _page_range(old)
    except StoreError:
        return encode_between(b"", b"")
    padding = first - footer_start(encode_between(b"", b""))
    if padding >= 0:
        return encode_between(b"", bytes(padding) + old[first:end])
    return encode_between(bytes(first - len(_MAGIC)) + old[first:end], b"")


def encode(table: pa.Table, before: bytes = b"", after: bytes = b"") -> bytes:
    """A compressed Parquet file with `before` and `after` around its pages. Text is dictionary-encoded."""
    text = [
        field.name for field in table.schema if pa.types.is_string(field.type) or pa.types.is_dictionary(field.type)
    ]
    return write(table, before, after, compression="zstd", compression_level=1, use_dictionary=text)


def write(
    table: pa.Table, before: bytes, after: bytes, metadata: Mapping[str, str] | None = None, **options: Any
) -> bytes:
    """A Parquet file with `before` and `after` around its pages. options: those of pyarrow's ParquetWriter."""
    sink = pa.BufferOutputStream()
    # With the stored Arrow schema, dictionary-encoded text would read back as a dictionary.
    with pq.ParquetWriter(sink, table.schema, store_schema=False, **options) as writer:
        sink.write(before)  # the writer asks the sink for its position
        writer.write_table(table)
        sink.write(after)
        if metadata:
            writer.add_key_value_metadata(metadata)
    return sink.getvalue().to_pybytes()


def footer_start(data: bytes | bytearray) -> int:
    """Where the footer of a Parquet file begins; 0 for data that are none."""
    return max(len(data) - 8 - int.from_bytes(data[-8:-4], "little"), 0)


def _metadata(data: bytes) -> pq.FileMetaData:
    return pq.read_metadata(pa.BufferReader(data))


def _page_range(data: bytes) -> tuple[int, int]:
    """Where the current version's pages begin and end, without the older versions around them.

    Raises:
        StoreError: the file is damaged.
    """
    file = open_table(data, _OLD)
    first, end = footer_start(data), len(_MAGIC)
    for number in range(file.num_row_groups):
        group = file.metadata.row_group(number)
        if not group.num_rows:
            continue
        with reading(_OLD):
            # group.column() ends the process if its part of the footer is damaged; reading the column raises an error.
            file.read_row_group(number, use_threads=False)
        if group.num_columns != file.metadata.num_columns:
            raise StoreError(f"{_OLD}: damaged: a group of rows has {group.num_columns} columns")
        for column in map(group.column, range(group.num_columns)):
            start = column.dictionary_page_offset or column.data_page_offset
            first, end = min(first, start), max(end, start + column.total_compressed_size)
    if not len(_MAGIC) <= min(first, end) <= end <= footer_start(data):
        raise StoreError(f"{_OLD}: damaged: its pages are not in the file")
    return min(first, end), end
