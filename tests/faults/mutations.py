"""What somebody's store can hold: seeded changes of a store on disk, for `tests.faults.fuzz_stores`.

A mutation is a function of a `Store` and a random generator. It changes the store and says what it did. It never writes
to `Store.outside`, the folder that the commands must not touch, except for further names of the files in it.
"""

# ruff: noqa: RUF001 (digits of other scripts are wanted)

import contextlib
import io
import json
import os
import random
import shutil
import socket
import stat
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
import yaml  # type: ignore[import-untyped]

from qnerf.records import live_parquet, summary_row

Random = random.Random

MARK = "qnerf-fuzz"
"""In every hostile HTML text; a page that has it as a tag would run it."""
DEEP = "@deep@"
"""Stands for a value nested too deeply for `json.dumps`."""

TEXTS = (
    "\x1b[31mred\x1b[0m\x07", "\x1b]0;title\x07", "\x9b31m", "\r\nerror: false", "a\nb\tc", "\x00", "\u202egpj.exe",
    "\u2066", "\ud800", "e\u0301" * 50, "\U0001f986", "١٢٣", "$\\frac{", "$x^{", "$$", "\\input{/etc/passwd}", "%s%n",
    "{0.__class__}", "[bold red]markup[/]", "[/]", f"<{MARK} onload=alert(1)>", f"</script><{MARK}>",
    "=cmd|' /C calc'!A0", "+1+1", "@SUM(1)", "a" * 100_000, "../../outside/new", "/etc/passwd", "null", "nan",
    "1e999", "2024-02-30", "", " ", "-rf", "--store", "0x10", "x,y;\"z'", "${oc.env:HOME}",
    "!!python/object/apply:os.system [id]", "???", "a=b", "|", "`id`",
)  # fmt: skip
NUMBERS = (
    0, 1, -1, 3, 2**31, 2**53 + 1, 2**63 - 1, 2**63, -(2**63), 2**64, 10**400, -0.0, 0.5, 1e-320, 1e-310, 1e16,
    253402300800.0, 1e308, -1e308, float("nan"), float("inf"), float("-inf"),
)  # fmt: skip


def value(rng: Random) -> Any:
    """Anything that JSON can hold, mostly what nobody expects."""
    simple = (None, True, False, [], {}, DEEP, [None], [[]], {"": None}, {"a": {"b": {"c": 1}}}, [1] * 10_000)
    return rng.choice((rng.choice(TEXTS), rng.choice(NUMBERS), rng.choice(simple)))


def dumped(content: Any) -> bytes:
    text = json.dumps(content)
    return text.replace(f'"{DEEP}"', "[" * 50_000 + "]" * 50_000).encode(errors="surrogatepass")


@dataclass
class Store:
    """A store to change.

    root: the store. outside: a folder with a copy of the store and of pictures and tables, not to be touched.
    targets: names in the store whose content was changed.
    """

    root: Path
    outside: Path
    targets: list[str] = field(default_factory=list)

    def paths(self, pattern: str = "**/*") -> list[Path]:
        return sorted(path for path in self.root.glob(pattern) if not path.parent.is_symlink())

    def runs(self) -> list[Path]:
        return [path for path in self.paths("*") if not path.name.startswith(".") and path.is_dir()]

    def run(self, rng: Random) -> Path:
        return self.touched(rng.choice(self.runs() or [self.root]))

    def file(self, rng: Random, *patterns: str) -> Path:
        """One of the regular files that match."""
        found = [path for pattern in patterns for path in self.paths(pattern) if is_regular(path)]
        if not found:
            raise Skipped
        kinds = sorted({path.name for path in found})  # the kind first: there are more of some than of others
        kind = rng.choice(kinds)
        return self.touched(rng.choice([path for path in found if path.name == kind]))

    def any(self, rng: Random) -> Path:
        """A file or a folder, at any level."""
        found = self.paths()
        if not found:
            raise Skipped
        kind = rng.choice(sorted({path.relative_to(self.root).parts[1:] or path.name[:1] for path in found}, key=str))
        found = [path for path in found if (path.relative_to(self.root).parts[1:] or path.name[:1]) == kind]
        return self.touched(rng.choice(found))

    def touched(self, path: Path) -> Path:
        self.targets += path.relative_to(self.root).parts[:1]
        return path

    def label(self, path: Path) -> str:
        """The path in messages: runs by the first word of their id that tells them apart."""
        return ascii(str(path.relative_to(self.root)))[1:-1] or "."


class Skipped(Exception):
    """The store has nothing that this mutation could change."""


Mutation = Callable[[Store, Random], str]
MUTATIONS: dict[str, Mutation] = {}


def mutation(function: Mutation) -> Mutation:
    MUTATIONS[function.__name__] = function
    return function


def is_regular(path: Path) -> bool:
    with contextlib.suppress(OSError, ValueError):
        return stat.S_ISREG(path.lstat().st_mode)
    return False


def shares_a_file(path: Path) -> bool:
    """Whether a file has another name, which may lie outside the store."""
    return path.is_file() and path.stat().st_nlink > 1


def remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def bytes_of(path: Path) -> bytes:
    if path.stat().st_size > 2**24:
        raise Skipped
    return path.read_bytes()


def put(path: Path, data: bytes) -> None:
    """A new file in the place of the old one, so that other names of the old one keep their content."""
    remove(path)
    path.write_bytes(data)


# Bytes and lengths


@mutation
def flip(store: Store, rng: Random) -> str:
    path = store.file(rng, "**/*")
    data = bytearray(bytes_of(path))
    for _ in range(rng.choice((1, 1, 4, 40))):
        if data:
            data[rng.choice((rng.randrange(len(data)), -1 - rng.randrange(min(len(data), 200))))] ^= 1 << rng.randrange(
                8
            )
    put(path, bytes(data))
    return f"bits of {store.label(path)} flipped"


@mutation
def cut(store: Store, rng: Random) -> str:
    path = store.file(rng, "**/*")
    data = bytes_of(path)
    length = rng.choice((0, 1, 4, 8, len(data) // 2, max(len(data) - 1, 0), rng.randrange(len(data) + 1)))
    put(path, data[:length])
    return f"{store.label(path)} cut to {length} bytes"


@mutation
def lengthen(store: Store, rng: Random) -> str:
    path = store.file(rng, "**/*")
    data = bytes_of(path)
    how = rng.choice(("doubled", "zeros", "bom", "utf16", "sparse", "garbage", "newline"))
    if how == "sparse":
        put(path, data)
        os.truncate(path, rng.choice((2**20 + 1, 2**26 + 1, 2**28 + 1, 2**32)))
    elif how == "utf16":
        put(path, data.decode(errors="replace").encode("utf-16"))
    else:
        before = {"bom": b"\xef\xbb\xbf", "newline": b"\r\n"}.get(how, b"")
        after = {"doubled": data, "zeros": bytes(1000), "garbage": rng.randbytes(1000)}.get(how, b"")
        put(path, before + data + after)
    return f"{store.label(path)}: {how}"


@mutation
def exchange(store: Store, rng: Random) -> str:
    """The content of another file."""
    path, other = store.file(rng, "**/*"), store.file(rng, "**/*")
    put(path, bytes_of(other))
    return f"{store.label(path)} holds {store.label(other)}"


@mutation
def missing(store: Store, rng: Random) -> str:
    path = store.any(rng)
    remove(path)
    return f"{store.label(path)} removed"


# JSON, YAML and texts


def changed_object(content: Any, rng: Random) -> str:
    """Changes one value or key somewhere in a JSON object; returns where."""
    where, node = "", content
    while isinstance(node, (dict, list)) and node:
        key: Any = rng.choice(list(node) if isinstance(node, dict) else range(len(node)))
        where = f"{where}.{key}"
        inner = node[key]
        if isinstance(inner, (dict, list)) and inner and rng.random() < 0.8:
            node = inner
            continue
        new = value(rng)
        kind = rng.random()
        if isinstance(node, dict) and kind < 0.1:
            del node[key]
            return f"{where} removed"
        if isinstance(node, dict) and kind < 0.2:
            node[rng.choice(TEXTS)] = new
            return f"{where} has a new neighbour {ascii(new)[:80]}"
        node[key] = new
        return f"{where} is {ascii(new)[:80]}"
    return where


JSON_FILES = (
    "*/status.json",
    "*/annotations.json",
    "*/environment*.json",
    "*/owner/*.json",
    "**/.annotations/owner/*.json",
)


@mutation
def json_value(store: Store, rng: Random) -> str:
    path = store.file(rng, *JSON_FILES)
    try:
        content = json.loads(bytes_of(path))
    except ValueError:
        raise Skipped from None
    where = changed_object(content, rng)
    put(path, dumped(content))
    return f"{store.label(path)}: {where}"


@mutation
def json_whole(store: Store, rng: Random) -> str:
    path = store.file(rng, *JSON_FILES)
    texts = (
        b"[" * 100_000, b'{"a":' * 100_000 + b"1" + b"}" * 100_000, b"1" * 10_000, b'{"step": 1' + b"0" * 5000 + b"}",
        b"NaN", b"null", b"[]", b'""', b"{}", b'{"state": "running"}', b'{"state": "finished"}', b'{"a": 1, "a": 2}',
        b"\xff\xfe", b'{"a": "\\ud800"}', b"", b" ", b"// comment\n{}",
        b'{"state": "failed", "error": "\\u001b[31m"}',
    )  # fmt: skip
    text = rng.choice(texts)
    put(path, text)
    return f"{store.label(path)} is {text[:40]!r}"


@mutation
def yaml_value(store: Store, rng: Random) -> str:
    path = store.file(rng, "*/config.yaml")
    try:
        content = yaml.safe_load(bytes_of(path))
    except (yaml.YAMLError, ValueError):
        raise Skipped from None
    if not isinstance(content, dict):
        raise Skipped
    if rng.random() < 0.1:
        content[rng.choice((None, 1, 1.5, True, (1, 2)))] = value(rng)
        where = "a key that is no text"
    else:
        where = changed_object(content, rng)
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    put(path, text.replace(DEEP, "[" * 2000 + "]" * 2000).encode(errors="surrogatepass"))
    return f"{store.label(path)}: {where}"


@mutation
def yaml_whole(store: Store, rng: Random) -> str:
    path = store.file(rng, "*/config.yaml")
    texts = (
        b"a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n", b"!!python/object/apply:os.system ['id']", b"null: 1\n",
        b"[]", b"- a\n- b\n", b"a: 2024-02-30\n", b"? [a, b]\n: c\n", b"%YAML 9.9\n---\na: 1\n", b"a: 1\n---\nb: 2\n",
        b"{" * 5000, b"a: " + b"[" * 5000, b"a: !!binary Zm9v\n", b"a: 1\na: 2\n", b"\x00", b"<<: {a: 1}\n",
        b"a: .nan\nb: .inf\n", b"a: 1_000\nb: 0o17\nc: 1:30\n", b"seed: 0\ntrain: null\nscene: null\n",
        b"plugins: [os]\n", b"x: " + b"1" * 5000, b"a: !!timestamp 9999-99-99\n", b"a: !!int 0x\n",
    )  # fmt: skip
    data = bytes_of(path)
    text = rng.choice(texts)
    put(path, text if rng.random() < 0.6 else data + text)
    return f"{store.label(path)} with {text[:40]!r}"


@mutation
def text_file(store: Store, rng: Random) -> str:
    name = rng.choice(("overrides.txt", "dirty.diff", "log.txt", "annotations.json"))
    path = store.run(rng) / name
    text = rng.choice(TEXTS)
    if name == "annotations.json":
        content = {"tags": [text, rng.choice(TEXTS), value(rng)], "note": rng.choice((text, value(rng)))}
        put(path, dumped(content))
    else:
        put(path, text.encode(errors="surrogatepass") * rng.choice((1, 3)))
    return f"{store.label(path)} with {ascii(text)[:40]}"


@mutation
def forged_state(store: Store, rng: Random) -> str:
    """A state that the files do not bear out."""
    run = store.run(rng)
    path = run / "status.json"
    try:
        status = json.loads(bytes_of(path))
    except (OSError, ValueError):
        status = {}
    if not isinstance(status, dict):
        status = {}
    moments = (0, -1, 1e9, 1e12, 1e17, 1e308, -1e308, 2**40, None, "2026-01-01T00:00:00+14:00", float("nan"), True)
    changes: dict[str, Any] = {
        "state": rng.choice(("finished", "running", "failed", "interrupted", "damaged", "", None, 1)),
        "heartbeat": rng.choice(moments),
        "created": rng.choice(moments),
        "step": rng.choice((-5, 0, 2, 10**6, 2**63, 1.5, float("nan"), "3", None, [])),
        "pid": rng.choice((0, 1, -1, os.getpid(), 2**31, 2**64, "1", None)),
        "host": rng.choice((*TEXTS, "elsewhere", None, 3)),
        "format": rng.choice((1, 2, 10**30, -1, "1", None, [], 1.5)),
        "error": rng.choice((*TEXTS, 3, ["x"])),
    }
    chosen = rng.sample(sorted(changes), rng.randrange(1, 5))
    status |= {key: changes[key] for key in chosen}
    put(path, dumped(status))
    return f"{store.label(path)}: " + ", ".join(f"{key}={ascii(changes[key])[:40]}" for key in chosen)


@mutation
def owner_files(store: Store, rng: Random) -> str:
    folder = store.run(rng) / rng.choice(("owner", "owner", ".annotations/owner"))
    if not folder.parent.is_dir() or folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise Skipped
    folder.mkdir(exist_ok=True)
    record = {
        "pid": rng.choice((os.getppid(), 1, 0, -1, 2**70, "x", None)), "host": rng.choice(("elsewhere", *TEXTS[:6])),
        "boot": "b", "started": "1", "nonce": rng.choice(("n", None, [], 1)),
        "since": rng.choice((0, 1e308, None, "x", 4e9)), "released": rng.choice((False, True, "no", None)),
    }  # fmt: skip
    name = rng.choice(
        ("0000000000009.json", "٠٠٠٠٠٩.json", "000009 (1).json", "999999999999999999999999.json", "-00001.json",
         "9.json", "000009.json\n", "000009.JSON", "９９９９.json", "000009.json", "1000000.json", ".000009.json.0.tmp",
         "9" * 240 + ".json")
    )  # fmt: skip
    (folder / name).write_bytes(rng.choice((dumped(record), dumped(record), b"", b"{}", b"[]", b"\xff")))
    return f"{store.label(folder)}/{ascii(name)[:50]} added"


# Tables

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
    rows = rng.choice((0, 2, 2, 1000, 10**6 if table.num_columns < 16 else 3000))
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


# Links and things that are no files


def outside_of(store: Store, path: Path, rng: Random) -> Path:
    """Something outside that looks like `path`, or something else."""
    twin = store.outside / "store" / path.relative_to(store.root)
    others = sorted(store.outside.rglob("*"))
    return twin if twin.exists() and rng.random() < 0.6 else rng.choice(others)


@mutation
def link(store: Store, rng: Random) -> str:
    path = store.any(rng)
    there = outside_of(store, path, rng)
    remove(path)
    path.symlink_to(there)
    return f"{store.label(path)} -> outside/{ascii(str(there.relative_to(store.outside)))[1:-1]}"


@mutation
def link_folder(store: Store, rng: Random) -> str:
    """One of the folders that commands write into or tidy, as a link."""
    names = (".tmp", ".index", "owner", "metrics", "images", ".annotations", ".annotations/owner")
    name = rng.choice(names)
    path = (store.root if name in (".tmp", ".index") else store.run(rng)) / name
    if not path.parent.is_dir() or path.parent.is_symlink():
        raise Skipped
    there = outside_of(store, path, rng)
    remove(path)
    path.symlink_to(there)
    return f"{store.label(path)} -> outside/{ascii(str(there.relative_to(store.outside)))[1:-1]}"


@mutation
def new_link(store: Store, rng: Random) -> str:
    """A link under a name that commands write, read or delete."""
    names = (
        "log.txt", "annotations.json", "checkpoint.prev.pt", "environment-2.json", "dirty.diff", "nonfinite.pt",
        "eval_hardware.parquet", "images/linked.png", "metrics/part-00001.parquet", "owner/000009.json",
        ".status.json.0a0a0a0a.tmp", ".annotations",
    )  # fmt: skip
    folder, name = rng.choice(
        ((store.run(rng), rng.choice(names)), (store.root, rng.choice((".tmp/old-x", ".tmp/new-x", "linked-run"))))
    )
    path = folder / name
    if not path.parent.is_dir() or path.parent.is_symlink():
        raise Skipped
    remove(path)
    there = rng.choice((outside_of(store, path, rng), store.outside / "absent"))
    path.symlink_to(there)
    store.touched(path)
    return f"{store.label(path)} -> outside/{ascii(str(there.relative_to(store.outside)))[1:-1]}"


@mutation
def odd_link(store: Store, rng: Random) -> str:
    """A loop, a dangling link, a device, a part of the store."""
    path = store.any(rng)
    there = rng.choice(
        (path, path.parent, "..", ".", "nowhere", "/dev/zero", "/dev/full", "/dev/stdin", "/proc/self/mem",
         "/proc/self/fd/0", "", store.root, str(store.any(rng)), "x" * 300)
    )  # fmt: skip
    remove(path)
    try:
        path.symlink_to(there)
    except OSError:
        raise Skipped from None
    return f"{store.label(path)} -> {str(there).replace(str(store.root), 'STORE')[:60]}"


@mutation
def special(store: Store, rng: Random) -> str:
    """A pipe, a socket, a device, or a folder in place of a file and the reverse."""
    path = store.any(rng)
    was_folder = path.is_dir()
    remove(path)
    how = rng.choice(("pipe", "socket", "device", "folder", "file", "tree"))
    if how == "pipe":
        os.mkfifo(path)
    elif how == "socket":
        with socket.socket(socket.AF_UNIX) as server, contextlib.chdir(path.parent):
            server.bind(path.name[:90])
    elif how == "device":
        try:
            os.mknod(path, 0o666 | stat.S_IFCHR, os.makedev(1, rng.choice((3, 5, 7))))
        except PermissionError:
            os.mkfifo(path)
    elif how == "folder" or (how == "file" and not was_folder):
        path.mkdir()
    elif how == "file":
        path.write_bytes(rng.choice((b"", b"x", b"{}")))
    else:
        (path / "a" / path.name).mkdir(parents=True)
        (path / "a" / "file").write_bytes(b"x")
    return f"{store.label(path)} is a {how}"


@mutation
def hard_link(store: Store, rng: Random) -> str:
    """A file that is also outside, as in a backup of hard links."""
    path = store.file(rng, "**/*")
    twin = store.outside / "store" / path.relative_to(store.root)
    if not is_regular(twin):
        raise Skipped
    remove(path)
    os.link(twin, path)
    return f"{store.label(path)} is a hard link to the file outside"


@mutation
def permissions(store: Store, rng: Random) -> str:
    if os.geteuid() == 0:
        raise Skipped
    path = store.any(rng)
    if shares_a_file(path):
        raise Skipped
    mode = rng.choice((0, 0o444, 0o222, 0o111, 0o555))
    path.chmod(mode)
    return f"{store.label(path)} has mode {mode:o}"


# Names, copies and times


@mutation
def copies(store: Store, rng: Random) -> str:
    """What file managers and sync programs leave."""
    path = store.any(rng)
    stem, suffix = path.stem, path.suffix
    name = rng.choice(
        (f"{stem} (1){suffix}", f"{stem}.sync-conflict-20260101{suffix}", f"{path.name}~", f".{path.name}.swp",
         f"._{path.name}", f"{path.name}\n", f"{stem}\u0661{suffix}", f"{path.name}.bak", path.name.upper(),
         f"{path.name}.partial", f" {path.name}", f".{path.name}.0a0a0a0a.tmp")
    )  # fmt: skip
    copy = path.with_name(name[:250])
    if os.path.lexists(copy):
        raise Skipped
    if path.is_dir() and not path.is_symlink():
        shutil.copytree(path, copy, symlinks=True)
    elif is_regular(path):
        shutil.copy2(path, copy)
    else:
        raise Skipped
    store.touched(copy)
    return f"{ascii(copy.name)[:80]} beside {store.label(path)}"


def hostile_name(rng: Random) -> bytes:
    texts = [text for text in TEXTS if text and "/" not in text and "\x00" not in text and len(text) < 200]
    extra = (
        b"\xff\xfe",
        b"x" * 255,
        b"a\nb",
        b"(1)",
        b"C:\\x",
        b"--yes",
        b"~",
        b"*",
        b"con",
        b"a" * 200 + b"-0123456789",
    )
    return rng.choice(
        (*extra, rng.choice(texts).encode(errors="surrogatepass"), rng.choice(texts).encode(errors="surrogatepass"))
    )


@mutation
def renamed(store: Store, rng: Random) -> str:
    """A run, a picture or a table under a name that qnerf would not choose."""
    path = rng.choice((store.run(rng), store.run(rng), store.any(rng)))
    name = hostile_name(rng)
    new = Path(os.fsdecode(os.path.join(os.fsencode(path.parent), name)))
    if path == store.root or os.path.lexists(new):
        raise Skipped
    old = store.label(path)
    os.rename(path, new)
    store.touched(new)
    return f"{old} is called {name!a}"


@mutation
def named_part(store: Store, rng: Random) -> str:
    """A part of the metrics or a picture under an odd name."""
    folder = store.run(rng) / rng.choice(("metrics", "images"))
    files = [path for path in sorted(folder.glob("*")) if is_regular(path)] if not folder.is_symlink() else []
    if not files:
        raise Skipped
    names = (
        "part-00000 (1).parquet", "part-٠٠٠٠١.parquet", "part-99999999999999999999.parquet", "part--1.parquet",
        "part-.parquet", "part-00001.parquet\n", "part-1.parquet", "part-00001.txt", "part-00000.parquet.crc",
        ".part-00001.parquet", "_SUCCESS", "a b.png", "$x^{.png", "\x1b[31m.png", f"<{MARK}>.png", "a.PNG",
        "a.png.png", ".png", "a\nb.png", "x" * 250 + ".png",
    )  # fmt: skip
    path = folder / rng.choice(names)
    if os.path.lexists(path):
        raise Skipped
    shutil.copy2(rng.choice(files), path)
    return f"{store.label(folder)}/{ascii(path.name)[:60]} added"


@mutation
def strangers(store: Store, rng: Random) -> str:
    """Files and folders in the store that are no runs, or look like something else."""

    def folder_with(name: str, file: str, data: bytes) -> None:
        (store.root / name).mkdir()
        (store.root / name / file).write_bytes(data)

    kinds: dict[str, Callable[[], object]] = {
        ".DS_Store": lambda: (store.root / ".DS_Store").write_bytes(b"\x00\x01"),
        "runs.parquet": lambda: (store.root / "runs.parquet").write_bytes(rng.choice((b"", b"PAR1", b"x"))),
        "views.parquet": lambda: pq.write_table(pa.table({"a": [1]}), store.root / "views.parquet"),
        "empty": lambda: (store.root / "empty").mkdir(),
        "project": lambda: folder_with("project", "config.yaml", b"a: 1\n"),
        "marked": lambda: folder_with("marked", "status.json", b"{}"),
        "nested": lambda: shutil.copytree(store.run(rng), store.run(rng) / "nested", symlinks=True),
        "zeros": lambda: folder_with("zeros", "summary.parquet", bytes(100)),
        "old": lambda: shutil.copytree(store.run(rng), store.root / ".tmp" / "old-x-00000000", symlinks=True),
        "file": lambda: (store.root / "a-file").write_bytes(b"x"),
    }  # fmt: skip
    name = rng.choice(sorted(kinds))
    try:
        kinds[name]()
    except (OSError, shutil.Error):
        raise Skipped from None
    store.targets.append(name)
    return f"{name} added to the store"


@mutation
def times(store: Store, rng: Random) -> str:
    path = store.any(rng)
    if path.is_symlink() or shares_a_file(path):
        raise Skipped
    moment = rng.choice((0, -1, -(2**31), 2**31, 2**33, 253402300800, 2**40))
    try:
        os.utime(path, (moment, moment))
    except (OSError, OverflowError):
        raise Skipped from None
    return f"{store.label(path)} is of {moment}"


# Pictures and checkpoints


def png(width: int, height: int, *chunks: bytes, data: bytes = b"", depth: int = 8, colour: int = 2) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    parts = [b"IHDR" + header, *chunks, b"IDAT" + zlib.compress(data), b"IEND"]
    packed = (struct.pack(">I", len(part) - 4) + part + struct.pack(">I", zlib.crc32(part)) for part in parts)
    return b"\x89PNG\r\n\x1a\n" + b"".join(packed)


@mutation
def picture(store: Store, rng: Random) -> str:
    path = store.file(rng, "*/images/*")
    data = bytes_of(path)
    pictures = {
        "eps": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n%%EndComments\n(x) show\n%%EOF\n",
        "400 megapixels": png(20_000, 20_000),
        "huge": png(2**31 - 1, 2**31 - 1),
        "empty": png(0, 0),
        "one pixel": png(1, 1, data=b"\0\0\0\0"),
        "line": png(100_000, 1, data=bytes(300_001)),
        "animation": png(4, 4, b"acTL" + struct.pack(">II", 10**6, 0), data=bytes(52)),
        "text bomb": png(4, 4, b"zTXta\0\0" + zlib.compress(bytes(10**8)), data=bytes(52)),
        "bomb": png(8000, 8000, data=bytes(8000 * 24_001)),
        "sixteen bits": png(4, 4, depth=16, colour=0, data=bytes(36)),
        "palette": png(4, 4, colour=3, data=bytes(20)),
        "odd depth": png(4, 4, depth=3, data=bytes(20)),
        "truncated": data[: len(data) * 2 // 3],
        "gif": b"GIF89a"
        + bytes([1, 0, 1, 0, 128, 0, 0, 0, 0, 0, 255, 255, 255, 44, 0, 0, 0, 0, 1, 0, 1, 0, 0, 2, 2, 68, 1, 0, 59]),
        "svg": f"<svg xmlns='http://www.w3.org/2000/svg' onload='alert(1)'><{MARK}/></svg>".encode(),
        "html": f"<html><{MARK}>".encode(),
        "tiff": b"II*\x00\x08\x00\x00\x00\xff\xff",
    }
    how = rng.choice(sorted(pictures))
    put(path, pictures[how])
    return f"{store.label(path)} is a picture: {how}"


def leaves(node: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths of everything in a checkpoint, containers included."""
    inner = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    return [path] * bool(path) + [leaf for key, child in inner for leaf in leaves(child, (*path, key))]


@mutation
def checkpoint(store: Store, rng: Random) -> str:
    """One leaf of a checkpoint, of another shape, type or value."""
    path = store.file(rng, "*/checkpoint*.pt")
    try:
        content = torch.load(io.BytesIO(bytes_of(path)), weights_only=True)
    except Exception:  # of any kind, where it was damaged before
        raise Skipped from None
    paths = leaves(content)
    if not paths:
        raise Skipped
    *parents, key = rng.choice(paths if rng.random() < 0.5 else [leaf for leaf in paths if len(leaf) == 1])
    node = content
    for parent in parents:
        node = node[parent]
    old = node[key]
    if isinstance(old, torch.Tensor) and rng.random() < 0.85:
        changes: dict[str, Callable[[], Any]] = {
            "shorter": lambda: old.flatten()[:-1].clone(),
            "longer": lambda: torch.cat([old.flatten(), old.flatten()]),
            "three": lambda: torch.zeros(3),
            "scalar": lambda: torch.tensor(1.0),
            "empty": lambda: torch.zeros(0),
            "transposed": lambda: old.reshape(*old.shape[::-1]),
            "nan": lambda: torch.full_like(old, float("nan")) if old.is_floating_point() else old + 1,
            "huge": lambda: torch.full(old.shape, 1e38) if old.is_floating_point() else torch.full_like(old, 127),
            "int": lambda: old.to(torch.int64),
            "double": lambda: old.to(torch.float64),
            "complex": lambda: old.to(torch.complex64),
            "half": lambda: old.to(torch.bfloat16),
            "sparse": lambda: old.to_sparse(),
            "stride": lambda: torch.zeros(1, dtype=old.dtype).expand(old.shape),
            "meta": lambda: old.to("meta"),
        }
        how = rng.choice(sorted(changes))
        try:
            new = changes[how]()
        except (RuntimeError, NotImplementedError):
            raise Skipped from None
    elif rng.random() < 0.2:
        how, new = "removed", None
    else:
        new = rng.choice(
            (
                None,
                -5,
                0,
                2,
                10**6,
                2**70,
                1.5,
                float("nan"),
                "x",
                [],
                {},
                torch.tensor(2),
                torch.zeros(3),
                True,
                [1.0, "x"],
            )
        )
        how = ascii(new)[:30]
    if how == "removed":
        del node[key]
    else:
        node[key] = new
    sink = io.BytesIO()
    try:
        torch.save(content, sink)
    except Exception:  # such as a tensor without data
        raise Skipped from None
    put(path, sink.getvalue())
    where = ".".join(map(str, (*parents, key)))
    return f"{store.label(path)}: {where} {how}"


@mutation
def checkpoint_whole(store: Store, rng: Random) -> str:
    path = store.file(rng, "*/checkpoint*.pt")
    kinds: dict[str, Callable[[Any], object]] = {
        "a list": lambda sink: torch.save([1, 2], sink),
        "an empty dict": lambda sink: torch.save({}, sink),
        "a tensor": lambda sink: torch.save(torch.zeros(3), sink),
        "code": lambda sink: torch.save({"step": os.system}, sink),
        "an old format": lambda sink: torch.save({"step": 2}, sink, _use_new_zipfile_serialization=False),
        "a bomb": lambda sink: _zip(sink, {"archive/data.pkl": bytes(10**7), "archive/version": b"3"}),
        "no pickle": lambda sink: _zip(sink, {"archive/version": b"3"}),
        "deep": lambda sink: _zip(
            sink, {"archive/data.pkl": b"\x80\x02" + b"]" * 100_000 + b".", "archive/version": b"3"}
        ),
    }
    how = rng.choice(sorted(kinds))
    sink = io.BytesIO()
    kinds[how](sink)
    put(path, sink.getvalue())
    return f"{store.label(path)} is {how}"


def _zip(sink: Any, files: dict[str, bytes]) -> None:
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
