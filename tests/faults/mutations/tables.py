"""Parquet tables: columns, cells, rows and what stands in their footers."""

import io
import json
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from qnerf.records import live_parquet, summary_row
from tests.faults.mutations.contents import changed_object
from tests.faults.mutations.store import NUMBERS, TEXTS, Random, Skipped, Store, bytes_of, dumped, mutation, put, value

TABLES = ("*/summary.parquet", "*/eval.parquet", "*/metrics/*.parquet", "*/*.parquet")


def column(rows: int, rng: Random) -> pa.Array:
    """A column that a run never writes."""
    text, number = rng.choice(TEXTS), rng.choice(NUMBERS)
    big = rng.choice((2**63 - 1, -(2**63), 0))
    kinds: dict[str, Callable[[], pa.Array]] = {
        "text": lambda: pa.array([text.encode(errors="replace").decode()] * rows, pa.string()),
        "large_text": lambda: pa.array(["x"] * rows, pa.large_string()), "null": lambda: pa.nulls(rows),
        "nulls": lambda: pa.nulls(rows, rng.choice((pa.float64(), pa.int64(), pa.string(), pa.bool_()))),
        "float": lambda: pa.array([float(max(min(number, 1e308), -1e308)) if number == number else number] * rows),
        "int": lambda: pa.array([big] * rows, pa.int64()),
        "unsigned": lambda: pa.array([2**64 - 1] * rows, pa.uint64()), "bool": lambda: pa.array([True] * rows),
        "binary": lambda: pa.array([b"\xff\x00"] * rows, pa.binary()),
        "fixed": lambda: pa.array([b"\xff\x00"] * rows, pa.binary(2)),
        "half": lambda: pa.array(np.full(rows, 1.5, np.float16)),
        "list": lambda: pa.array([[1.0, None]] * rows, pa.list_(pa.float64())),
        "struct": lambda: pa.array([{"a": 1, "b": {"c": "x"}}] * rows),
        "map": lambda: pa.array([[("a", 1)]] * rows, pa.map_(pa.string(), pa.int64())),
        "seconds": lambda: pa.array([big] * rows, pa.timestamp("us")),
        "zone": lambda: pa.array([0] * rows, pa.timestamp("ns", tz=rng.choice(("+14:00", "No/Where", "UTC")))),
        "duration": lambda: pa.array([big] * rows, pa.duration("us")),
        "date": lambda: pa.array([2**31 - 1] * rows, pa.date32()),
        "time": lambda: pa.array([1] * rows, pa.time64("ns")),
        "decimal": lambda: pa.array([10**37] * rows, pa.decimal128(38)),
        "dictionary": lambda: pa.array(["a"] * rows).dictionary_encode(),
        "huge": lambda: pa.array(["x" * 10**7] * min(rows, 4) + [""] * max(rows - 4, 0)),
        "mixed": lambda: pa.array([None if row % 2 else float(row) for row in range(rows)], pa.float64()),
    }  # fmt: skip
    return kinds[rng.choice(sorted(kinds))]()


def read_table(path: Path) -> pa.Table:
    try:
        return pq.ParquetFile(pa.BufferReader(bytes_of(path))).read(use_threads=False)
    except (pa.ArrowException, OSError, ValueError):
        raise Skipped from None


def write_table(path: Path, table: pa.Table, rng: Random) -> None:
    sink = io.BytesIO()
    try:
        pq.write_table(table, sink, compression=rng.choice(("none", "snappy", "zstd")))
    except (pa.ArrowException, OSError, OverflowError):
        raise Skipped from None
    put(path, sink.getvalue())


@mutation
def table_column(store: Store, rng: Random) -> str:
    path = store.file(rng, rng.choice(TABLES))
    table = read_table(path)
    if not table.num_columns:
        raise Skipped
    what = []
    for _ in range(rng.choice((1, 1, 3, 12))):
        number = rng.randrange(table.num_columns)
        new = column(table.num_rows, rng)
        name = table.schema.names[number]
        table = table.set_column(number, name, new)
        what.append(f"{name} is {new.type}")
    write_table(path, table, rng)
    return f"{store.label(path)}: {', '.join(what)}"


@mutation
def table_columns(store: Store, rng: Random) -> str:
    path = store.file(rng, rng.choice(TABLES))
    table = read_table(path)
    if not table.num_columns:
        raise Skipped
    number = rng.randrange(table.num_columns)
    name = table.schema.names[number]
    how = rng.choice(("removed", "doubled", "renamed", "added", "shuffled", "none"))
    hostile = rng.choice((*TEXTS, "run_id", "state", "path", "repeats", "scene_name", ".damaged", "tags")).encode(
        errors="replace"
    )
    if how == "removed":
        table = table.remove_column(number)
    elif how == "doubled":
        table = table.append_column(name, rng.choice((table.column(number), column(table.num_rows, rng))))
    elif how == "renamed":
        table = table.rename_columns([hostile.decode() if n == name else n for n in table.schema.names])
    elif how == "added":
        table = table.append_column(hostile.decode(), column(table.num_rows, rng))
    elif how == "shuffled":
        table = table.select(rng.sample(range(table.num_columns), table.num_columns))
    else:
        table = table.select([])
    write_table(path, table, rng)
    return f"{store.label(path)}: column {name} {how} {ascii(hostile)[:40] if how in ('renamed', 'added') else ''}"


@mutation
def table_rows(store: Store, rng: Random) -> str:
    path = store.file(rng, rng.choice(TABLES))
    table = read_table(path)
    rows = rng.choice((0, 2, 2, 1000, 200_000 if table.num_columns < 16 else 3000))
    if not table.num_rows:
        raise Skipped
    table = table.take(pa.array(np.arange(rows) % table.num_rows))
    write_table(path, table, rng)
    return f"{store.label(path)} with {rows} rows"


@mutation
def table_metadata(store: Store, rng: Random) -> str:
    path = store.file(rng, rng.choice(TABLES))
    table = read_table(path)
    pandas = rng.choice(
        (b"garbage", b"{}", b"[]", dumped({"index_columns": ["no"], "columns": [], "column_indexes": [value(rng)]}))
    )
    metadata = rng.choice(
        ({b"pandas": pandas}, {b"ARROW:schema": b"garbage"}, {b"qnerf": b"garbage"}, {b"\xff": b"\xff" * 10**5},
         {b"qnerf.index": b"[2, 3]"})
    )  # fmt: skip
    write_table(path, table.replace_schema_metadata(metadata), rng)
    return f"{store.label(path)} with metadata {ascii(metadata)[:60]}"


@mutation
def table_cells(store: Store, rng: Random) -> str:
    """Other values in columns of the right type."""
    path = store.file(rng, rng.choice(TABLES))
    table = read_table(path)
    if not table.num_rows:
        raise Skipped
    what = []
    for number in rng.sample(range(table.num_columns), min(rng.choice((1, 2, 8)), table.num_columns)):
        kind, name = table.schema.types[number], table.schema.names[number]
        cells = table.column(number).to_pylist()
        row = rng.randrange(table.num_rows)
        if pa.types.is_floating(kind):
            number_ = rng.choice(NUMBERS)
            new: Any = float(number_) if abs(number_) < 1e308 or number_ != number_ else float("inf")
        elif pa.types.is_integer(kind):
            new = rng.choice((0, -1, -5, 2**62, 2**63 - 1, -(2**63), None))
        elif pa.types.is_string(kind):
            new = rng.choice((*TEXTS, None)) or None
            new = new and new.encode(errors="replace").decode()
        else:
            new = None
        cells[row] = new
        try:
            table = table.set_column(number, name, pa.array(cells, kind))
        except (pa.ArrowException, OverflowError):
            raise Skipped from None
        what.append(f"{name}={ascii(new)[:40]}")
    write_table(path, table, rng)
    return f"{store.label(path)}: {', '.join(what)}"


@mutation
def forged_row(store: Store, rng: Random) -> str:
    """The copy of the row in the footer of summary.parquet, with a right checksum and other content."""
    path = store.file(rng, "*/summary.parquet")
    try:
        names, types, values = summary_row.decode(bytes_of(path))
    except (ValueError, OSError):
        raise Skipped from None
    row: list[Any] = [names, types, values]
    part = rng.choice((0, 1, 2, 2, 2))
    number = rng.randrange(len(names) or 1)
    wanted = {1: ("int64", "double", "string", "bool", "null", "timestamp[us]", "", "text")}.get(part)
    new = rng.choice(wanted) if wanted else value(rng)
    if names and rng.random() < 0.8:
        row[part][number] = new
    else:
        row[part] = rng.choice((new, row[part][:-1], []))
    repeated = dumped(["qnerf.row", "00000000", *row]).decode(errors="replace")
    table = pa.table({"a": [1]})
    data = bytearray(live_parquet.write(table, b"", b"", {"qnerf": repeated}, compression="none"))
    start = data.index(summary_row._MARKER, live_parquet.footer_start(data))
    position = start + len(summary_row._MARKER)
    data[position : position + 8] = summary_row._checksum(data, start)
    put(path, bytes(data))
    return f"{store.label(path)}: forged {('name', 'type', 'value')[part]} of {names[number]}: {ascii(new)[:60]}"


@mutation
def forged_index(store: Store, rng: Random) -> str:
    """An index of another content with a right checksum."""
    path = store.file(rng, ".index/*.index")
    content = bytes_of(path)[4:]
    try:
        file = pq.ParquetFile(pa.BufferReader(content))
        table = file.read(use_threads=False)
        known = dict(file.metadata.metadata or {})
    except (pa.ArrowException, OSError):
        raise Skipped from None
    metadata = {b"qnerf.index": known.get(b"qnerf.index", b"[2, []]")}
    how = rng.choice(("column", "metadata", "rows", "removed"))
    if how == "column" and table.num_columns:
        number = rng.randrange(table.num_columns)
        how = f"column {table.schema.names[number]}"
        table = table.set_column(number, table.schema.names[number], column(table.num_rows, rng))
    elif how == "removed" and table.num_columns:
        number = rng.randrange(table.num_columns)
        how = f"column {table.schema.names[number]} removed"
        table = table.remove_column(number)
    elif how == "rows" and table.num_rows:
        table = table.take(pa.array(np.arange(rng.choice((0, 1, 500))) % table.num_rows))
    else:
        shapes = json.loads(metadata[b"qnerf.index"])
        how = f"metadata {changed_object(shapes, rng)}"
        metadata = {b"qnerf.index": dumped(shapes)}
    sink = io.BytesIO()
    try:
        pq.write_table(table.replace_schema_metadata(metadata), sink)
    except (pa.ArrowException, OSError):
        raise Skipped from None
    data = sink.getvalue()
    put(path, zlib.crc32(data).to_bytes(4, "little") + data)
    return f"{store.label(path)}: forged {how}"
