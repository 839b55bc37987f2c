"""The index on disk, one file for each kind of a run's files: four bytes of checksum, then a Parquet file."""

import contextlib
import io
import json
import os
import zlib
from collections.abc import Callable, Collection, Sequence
from itertools import pairwise
from pathlib import Path

import pyarrow.parquet as pq

from qnerf.records.files import StoreError, read_bytes, remove_temporary_files, replace
from qnerf.records.index.ragged_rows import (
    HEAD_SCHEMA,
    KEY,
    SHAPE,
    STAMP,
    RaggedTable,
    RowShape,
    column_names,
    schema_of,
)
from qnerf.records.parquet import open_table, read_columns, reading

FORMAT = 3
"""Of the file and of its entries. A file in another format is ignored and replaced."""

_METADATA = b"qnerf.index"
_MAX_BYTES = 2**31
_ABANDONED_S = 3600.0  # no process takes so long to write an index


class StoredIndex:
    """Entries that were read before. keys: their runs. stamps: the versions of the files that they were read from.

    A store may come with an index that somebody else wrote. One that `save` would not have written counts as none.
    """

    def __init__(self, file: pq.ParquetFile | None = None, shapes: Sequence[RowShape] = (), label: str = "") -> None:
        self._file, self._shapes, self._label = file, tuple(shapes), label
        head = read_columns(file, label, HEAD_SCHEMA.names) if file else HEAD_SCHEMA.empty_table()
        self.keys: list[str] = head[KEY].to_pylist()
        self.stamps: list[str] = head[STAMP].to_pylist()
        if any(column.null_count for column in head.columns):
            raise StoreError(f"{label}: expected a key, a stamp and a shape in every row")
        if any(key >= following for key, following in pairwise(self.keys)):
            raise StoreError(f"{label}: expected each run once, sorted by name")
        if not set(head[SHAPE].unique().to_pylist()) <= set(range(len(self._shapes))):
            raise StoreError(f"{label}: expected numbers of its {len(self._shapes)} shapes")

    @classmethod
    def load(cls, folders: Sequence[Path], name: str, check: Callable[[RowShape], None]) -> "StoredIndex":
        """From the first folder that has an undamaged one of this format; empty if none has.

        check: raises ValueError for a shape that no entry of this index has.
        """
        for folder in folders:
            with contextlib.suppress(OSError, StoreError), reading(name):
                return cls._parse(read_bytes(folder / name, _MAX_BYTES), name, check)
        return cls()

    @classmethod
    def _parse(cls, data: bytes, name: str, check: Callable[[RowShape], None]) -> "StoredIndex":
        checksum, content = data[:4], data[4:]
        if checksum != _checksum(content):
            raise ValueError("damaged")
        file = open_table(content, name)
        version, stored_shapes = json.loads((file.metadata.metadata or {})[_METADATA])
        if version != FORMAT:
            raise ValueError("another format")
        shapes = [RowShape(tuple(names), tuple(kinds)) for names, kinds in stored_shapes]
        for shape in shapes:
            check(shape)
        if not file.metadata.schema.to_arrow_schema().equals(schema_of(shapes)):
            raise ValueError("its columns are not those of its shapes")
        return cls(file, shapes, name)

    def entries(self, names: Collection[str] | None = None) -> RaggedTable:
        """All entries, with at least the values of these names. StoreError if they cannot be read."""
        if self._file is None:
            return RaggedTable(HEAD_SCHEMA.empty_table(), ())
        columns = None if names is None else [*HEAD_SCHEMA.names, *column_names(self._shapes, names)]
        return RaggedTable(read_columns(self._file, self._label, columns), self._shapes)


def save(entries: RaggedTable, folders: Sequence[Path], name: str) -> None:
    """Writes to the first folder that can be written; nowhere if none can."""
    shapes = [[shape.names, shape.kinds] for shape in entries.shapes]
    sink = io.BytesIO()
    with pq.ParquetWriter(sink, entries.table.schema, compression="zstd", compression_level=1) as writer:
        writer.write_table(entries.table)
        writer.add_key_value_metadata({_METADATA: json.dumps([FORMAT, shapes])})
    content = sink.getvalue()
    for folder in folders:
        with contextlib.suppress(OSError, StoreError):
            os.makedirs(folder, exist_ok=True)
            if folder.is_symlink():  # files behind it are not ours to replace
                continue
            replace(folder / name, _checksum(content) + content, durable=False)
            remove_temporary_files(folder, age_s=_ABANDONED_S)
            return


def _checksum(content: bytes) -> bytes:
    return zlib.crc32(content).to_bytes(4, "little")
