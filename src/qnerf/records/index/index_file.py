"""The index on disk, one file for each kind of a run's files: four bytes of checksum, then a Parquet file."""

import contextlib
import io
import json
import os
import zlib
from collections.abc import Collection, Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from qnerf.records.files import StoreError, read_bytes, remove_temporary_files, replace
from qnerf.records.index.ragged_rows import HEAD_SCHEMA, KEY, STAMP, RaggedTable, RowShape, column_name, column_names
from qnerf.records.parquet import KINDS

FORMAT = 3
"""Of the file and of its entries. A file in another format is ignored and replaced."""

_METADATA = b"qnerf.index"
_MAX_BYTES = 2**31
_ABANDONED_S = 3600.0  # no process takes so long to write an index


class StoredIndex:
    """Entries that were read before. keys: their runs. stamps: the versions of the files that they were read from."""

    def __init__(self, file: pq.ParquetFile | None = None, shapes: Sequence[RowShape] = ()) -> None:
        self._file, self._shapes = file, tuple(shapes)
        head = file.read([KEY, STAMP], use_threads=False) if file else HEAD_SCHEMA.empty_table()
        self.keys: list[str] = head[KEY].to_pylist()
        self.stamps: list[str] = head[STAMP].to_pylist()

    @classmethod
    def load(cls, folders: Sequence[Path], name: str) -> "StoredIndex":
        """From the first folder that has an undamaged one of this format; empty if none has."""
        for folder in folders:
            with contextlib.suppress(OSError, ValueError, LookupError):
                return cls._parse(read_bytes(folder / name, _MAX_BYTES))
        return cls()

    @classmethod
    def _parse(cls, data: bytes) -> "StoredIndex":
        checksum, content = data[:4], data[4:]
        if checksum != _checksum(content):
            raise ValueError("damaged")
        file = pq.ParquetFile(pa.BufferReader(content))
        version, shapes = json.loads((file.metadata.metadata or {})[_METADATA])
        if version != FORMAT:
            raise ValueError("another format")
        stored = cls(file, [RowShape(tuple(names), tuple(kinds)) for names, kinds in shapes])
        stored._check()
        return stored

    def _check(self) -> None:
        """ValueError if a shape names a column that the file does not have: a store may come with a forged index."""
        assert self._file is not None
        types = dict(zip(self._file.schema_arrow.names, self._file.schema_arrow.types, strict=True))
        for shape in self._shapes:
            for name, kind in zip(shape.names, shape.kinds, strict=True):
                if kind != "none" and types.get(column_name(kind, name)) != KINDS[kind]:
                    raise ValueError(f"has no column {column_name(kind, name)}")

    def entries(self, names: Collection[str] | None = None) -> RaggedTable:
        """All entries, with at least the values of these names."""
        if self._file is None:
            return RaggedTable(HEAD_SCHEMA.empty_table(), ())
        columns = None if names is None else [*HEAD_SCHEMA.names, *column_names(self._shapes, names)]
        return RaggedTable(self._file.read(columns, use_threads=False), self._shapes)


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
