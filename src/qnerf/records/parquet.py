"""The one reader of Parquet files: a table of numbers and text, within limits on everything that it could unpack to.

Run-length encoding and dictionaries put more rows or text than fit into memory into a few bytes. So the limits are
checked before anything is unpacked.
"""

import contextlib
from collections.abc import Iterator, Mapping, Sequence

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from qnerf.records.files import StoreError, one_line

MAX_ROWS = 2**22
MAX_COLUMNS = 2**14
MAX_UNPACKED_BYTES = 2**30

KINDS = {"int": pa.int64(), "float": pa.float64(), "bool": pa.bool_(), "text": pa.string(), "none": pa.null()}
KIND_OF_TYPE = {
    **dict.fromkeys(("int64", "int32", "int16", "int8", "uint32", "uint16", "uint8"), "int"),
    **dict.fromkeys(("double", "float", "halffloat"), "float"),
    **dict.fromkeys(("string", "large_string"), "text"),
    "bool": "bool",
    "null": "none",
}
"""Name of an Arrow type -> the kind that holds its values."""


@contextlib.contextmanager
def reading(label: object) -> Iterator[None]:
    """Turns every error of a reader of damaged data into the StoreError "LABEL: damaged: REASON"."""
    try:
        yield
    except StoreError:
        raise
    except Exception as error:  # pyarrow and Pillow raise errors of many kinds for damaged files
        raise StoreError(f"{label}: damaged: {one_line(error)}") from error


def open_table(data: bytes, label: object, *, max_rows: int = MAX_ROWS) -> pq.ParquetFile:
    """A Parquet file in memory, before anything of it is unpacked. Text is read as dictionaries.

    label: the path or URL for error messages.

    Raises:
        StoreError: it is damaged, has nested columns, or would unpack to more than a run writes.
    """
    with reading(label):
        # Not pq.read_table: if its threads still hold Python's buffer when the interpreter ends, the process aborts.
        metadata = pq.read_metadata(pa.BufferReader(data))
        columns = [metadata.schema.column(number) for number in range(metadata.num_columns)]
        _limit(label, metadata.num_rows, max_rows, "rows")
        _limit(label, len(columns), MAX_COLUMNS, "columns")
        if any(column.max_repetition_level or column.path != column.name for column in columns):
            raise ValueError("expected columns of numbers and text, got nested ones")
        # Not the sizes of single columns: pyarrow ends the process when their part of the footer is damaged.
        sizes = [metadata.row_group(number).total_byte_size for number in range(metadata.num_row_groups)]
        _limit(label, sum(max(size, 0) for size in sizes), MAX_UNPACKED_BYTES, "bytes when unpacked")
        _limit(label, metadata.num_rows * len(columns), MAX_UNPACKED_BYTES // 8, "values")
        text = [column.path for column in columns if column.physical_type == "BYTE_ARRAY"]
        return pq.ParquetFile(pa.BufferReader(data), metadata=metadata, read_dictionary=text)


def read_columns(file: pq.ParquetFile, label: object, columns: Sequence[str] | None = None) -> pa.Table:
    """The columns of an opened file, all by default. Values that are neither numbers nor text become text.

    Raises:
        StoreError: the file is damaged or its text would unpack to more than a run writes.
    """
    with reading(label):
        table = file.read(columns, use_threads=False)
        _limit(label, sum(map(_unpacked_bytes, table.columns)), MAX_UNPACKED_BYTES, "bytes when unpacked")
        return pa.table(list(map(_plain, table.columns)), names=table.schema.names)


def parse_table(data: bytes, label: object, *, max_rows: int = MAX_ROWS) -> pa.Table:
    """All columns of a Parquet file in memory; StoreError as `open_table` and `read_columns` raise it."""
    return read_columns(open_table(data, label, max_rows=max_rows), label)


def with_kinds(table: pa.Table, kinds: Mapping[str, str], label: object) -> pa.Table:
    """The table with the columns named in `kinds` cast to them; its other columns stay. StoreError as `check_kinds`."""
    check_kinds(table, kinds, label)
    for name, kind in kinds.items():
        with reading(label):
            number = table.schema.get_field_index(name)
            table = table.set_column(number, name, table.column(number).cast(KINDS[kind]))
    return table


def check_kinds(table: pa.Table, kinds: Mapping[str, str], label: object) -> None:
    """StoreError if one of these columns is missing or holds values of another kind, or any column occurs twice."""
    names = table.schema.names
    if len(set(names)) < len(names):
        doubled = next(name for name in names if names.count(name) > 1)
        raise StoreError(f"{label}: damaged: expected one column {doubled}, got {names.count(doubled)}")
    for name, kind in kinds.items():
        if name not in names:
            raise StoreError(f"{label}: damaged: expected one column {name}, got 0")
        actual = table.schema.field(name).type
        if not fits(KIND_OF_TYPE.get(str(actual), "other"), kind):
            raise StoreError(f"{label}: damaged: {name}: expected {NAMES[kind]}, got {actual}")


NAMES = {"int": "whole numbers", "float": "numbers", "bool": "true or false", "text": "text"}
_ALLOWED = {("int", "float"), *((kind, kind) for kind in KINDS), *(("none", kind) for kind in KINDS)}


def fits(kind: str, expected: str) -> bool:
    """Whether values of one kind can stand in a column of another: whole numbers are numbers, and none is anything.

    >>> fits("int", "float"), fits("text", "float")
    (True, False)
    """
    return (kind, expected) in _ALLOWED


def _limit(label: object, number: int, maximum: int, unit: str) -> None:
    if number > maximum:
        raise StoreError(f"{label}: has {number:,} {unit}; expected at most {maximum:,}")


def _unpacked_bytes(column: pa.ChunkedArray) -> int:
    if not pa.types.is_dictionary(column.type):
        return int(column.nbytes)
    lengths = (pc.binary_length(chunk.dictionary).take(chunk.indices) for chunk in column.chunks)
    return sum(pc.sum(pc.cast(each, pa.int64())).as_py() or 0 for each in lengths)


def _plain(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """The column as numbers, booleans or text."""
    kind = column.type.value_type if pa.types.is_dictionary(column.type) else column.type
    is_number = str(kind) in KIND_OF_TYPE and not pa.types.is_large_string(kind)
    plain = column.cast(kind if is_number else pa.string())
    plain.validate(full=True)  # text is UTF-8
    return plain
