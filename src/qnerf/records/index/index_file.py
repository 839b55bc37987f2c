"""The index of one file of every run, as it lies on disk: a checksum of four bytes, then a Parquet file."""

import contextlib
import io
import json
import os
import zlib
from collections.abc import Collection, Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from qnerf.records.files import StoreError, read_bytes, remove_leftovers, replace
from qnerf.records.index.ragged_rows import KEY, SCHEMA, STAMP, Rows, Shape, physicals

FORMAT = 2
"""Of the index and of what its entries hold; one of another format is built anew."""

_METADATA = b"qnerf.index"
_MOST_BYTES = 2**31
_LEFT_S = 3600.0
"""Nobody writes an index for so long: a temporary file of that age is of somebody who was killed."""


class Kept:
    """Entries that were read before. keys: their runs; stamps: of the files that they were read from."""

    def __init__(self, file: pq.ParquetFile | None = None, shapes: Sequence[Shape] = ()) -> None:
        self._file, self._shapes = file, tuple(shapes)
        head = file.read([KEY, STAMP], use_threads=False) if file else SCHEMA.empty_table()
        self.keys: list[str] = head[KEY].to_pylist()
        self.stamps: list[str] = head[STAMP].to_pylist()

    @classmethod
    def load(cls, folders: Sequence[Path], name: str) -> "Kept":
        """Of the first folder that has a whole one of this format; empty where none has."""
        for folder in folders:
            with contextlib.suppress(OSError, ValueError, LookupError):
                return cls._read(read_bytes(folder / name, _MOST_BYTES))
        return cls()

    @classmethod
    def _read(cls, data: bytes) -> "Kept":
        checksum, content = data[:4], data[4:]
        if checksum != _checksum(content):
            raise ValueError("damaged")
        file = pq.ParquetFile(pa.BufferReader(content))
        version, shapes = json.loads((file.metadata.metadata or {})[_METADATA])
        if version != FORMAT:
            raise ValueError("another format")
        return cls(file, [Shape(tuple(names), tuple(kinds)) for names, kinds in shapes])

    def rows(self, names: Collection[str] | None = None) -> Rows:
        """All entries, with at least the named values."""
        if self._file is None:
            return Rows(SCHEMA.empty_table(), ())
        columns = None if names is None else [*SCHEMA.names, *physicals(self._shapes, names)]
        return Rows(self._file.read(columns, use_threads=False), self._shapes)


def save(rows: Rows, folders: Sequence[Path], name: str) -> None:
    """Into the first folder that can be written; nowhere if none can."""
    shapes = [[shape.names, shape.kinds] for shape in rows.shapes]
    sink = io.BytesIO()
    with pq.ParquetWriter(sink, rows.table.schema, compression="zstd", compression_level=1) as writer:
        writer.write_table(rows.table)
        writer.add_key_value_metadata({_METADATA: json.dumps([FORMAT, shapes])})
    content = sink.getvalue()
    for folder in folders:
        with contextlib.suppress(OSError, StoreError):
            os.makedirs(folder, exist_ok=True)
            if folder.is_symlink():  # what lies where it leads is not ours to replace
                continue
            replace(folder / name, _checksum(content) + content, durable=False)
            remove_leftovers(folder, age_s=_LEFT_S)
            return


def _checksum(content: bytes) -> bytes:
    return zlib.crc32(content).to_bytes(4, "little")
