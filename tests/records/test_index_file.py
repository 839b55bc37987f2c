"""The index on disk: damaged, in another format, not writable, refreshed by several processes at once."""

import io
import json
import os
import threading
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from qnerf.records import index
from qnerf.records.index import index_file, locations
from qnerf.records.index.locations import ANNOTATIONS, STATUS, SUMMARY
from tests.helpers.summaries import load_without_index, write


def spoil(path: Path, how: str) -> None:
    data = path.read_bytes()
    path.write_bytes(
        {
            "empty": b"",
            "cut": data[: len(data) // 2],
            "flipped": data[:100] + bytes([data[100] ^ 1]) + data[101:],
            "flipped footer": data[:-60] + bytes([data[-60] ^ 1]) + data[-59:],
            "other": b"hello" * 100,
        }[how]
    )


@pytest.mark.usefixtures("settled")
@pytest.mark.parametrize("how", ["empty", "cut", "flipped", "flipped footer", "other"])
def test_a_damaged_index_counts_as_none(tmp_path: Path, how: str) -> None:
    store = tmp_path / "runs"
    for name in "ab":
        write(store, name, psnr=1.0)
    expected = index.load(store)
    written = sorted((store / ".index").iterdir())
    assert [path.name for path in written] == ["status.json.index", "summary.parquet.index"]
    for path in written:
        spoil(path, how)
    pd.testing.assert_frame_equal(index.load(store), expected)
    for path in written:
        assert index_file.StoredIndex.load([store / ".index"], path.name, lambda shape: None).keys == ["a", "b"]


def shapes_of(data: bytes) -> Any:
    return json.loads(pq.read_metadata(pa.BufferReader(data[4:])).metadata[b"qnerf.index"])


def forge(path: Path, change: Callable[[pa.Table], pa.Table] = lambda table: table, metadata: str = "") -> None:
    """Another index with a right checksum. metadata: the format and the shapes, by default as they are."""
    data = path.read_bytes()
    metadata = metadata or json.dumps(shapes_of(data))
    table = change(pq.read_table(pa.BufferReader(data[4:])))
    sink = io.BytesIO()
    pq.write_table(table.replace_schema_metadata({"qnerf.index": metadata}), sink)
    content = sink.getvalue()
    path.write_bytes(zlib.crc32(content).to_bytes(4, "little") + content)


def column(name: str, kind: pa.DataType, *values: object) -> Callable[[pa.Table], pa.Table]:
    """Replaces a column, or adds one."""

    def change(table: pa.Table) -> pa.Table:
        number, array = table.schema.get_field_index(name), pa.array(values, kind)
        return table.append_column(name, array) if number < 0 else table.set_column(number, name, array)

    return change


FORGED = {
    "key of another type": (SUMMARY, column("key", pa.decimal128(38, 0), 1, 2)),
    "keys in bytes": (SUMMARY, column("key", pa.binary(), b"a", b"b")),
    "key absent": (SUMMARY, column("key", pa.string(), "a", None)),
    "keys twice": (SUMMARY, column("key", pa.string(), "a", "a")),
    "keys not sorted": (SUMMARY, column("key", pa.string(), "b", "a")),
    "stamp of another type": (STATUS, column("stamp", pa.list_(pa.int64()), [1], [2])),
    "stamp absent": (STATUS, column("stamp", pa.string(), "1", None)),
    "shape with a fraction": (ANNOTATIONS, column("shape", pa.float64(), 0.0, 0.5)),
    "shape absent": (ANNOTATIONS, column("shape", pa.int32(), 0, None)),
    "no such shape": (ANNOTATIONS, column("shape", pa.int32(), 0, 1)),
    "shape below 0": (ANNOTATIONS, column("shape", pa.int32(), 0, -1)),
    "value of another type": (SUMMARY, column("float psnr", pa.string(), "1", "2")),
    "value in a dictionary": (STATUS, column("text state", pa.dictionary(pa.int8(), pa.int64()), 1, 2)),
    "another column": (SUMMARY, column("text stranger", pa.string(), "x", "y")),
    "column removed": (SUMMARY, lambda table: table.drop_columns(["float psnr"])),
    "column twice": (SUMMARY, lambda table: table.append_column("float psnr", table["float psnr"])),
    "unknown state": (STATUS, column("text state", pa.string(), "finished", "asleep")),
    "step below 0": (STATUS, column("int step", pa.int64(), 3, -1)),
    "time far away": (STATUS, column("float created", pa.float64(), 1.0, 1e300)),
    "time not a number": (STATUS, column("float heartbeat", pa.float64(), 1.0, float("nan"))),
    "record no object": (STATUS, column("text record", pa.string(), None, "[1]")),
    "record with a step in text": (STATUS, column("text record", pa.string(), None, '{"step": "x"}')),
    "tags no list": (ANNOTATIONS, column("text tags", pa.string(), "[]", "{")),
    "tags of numbers": (ANNOTATIONS, column("text tags", pa.string(), "[]", "[1]")),
}


@pytest.fixture
def indexed(tmp_path: Path) -> Path:
    """A store of two runs with an index of each kind of file."""
    for name, value in (("a", 1.0), ("b", 2.0)):
        run = write(tmp_path / "runs", name, psnr=value)
        (run / ANNOTATIONS).write_text(json.dumps({"tags": ["good"], "note": "x"}))
    index.load(tmp_path / "runs")
    return tmp_path / "runs"


def check_ignored_and_rebuilt(store: Path, file: str, reads: list[tuple[str, str]]) -> None:
    expected = load_without_index(store)
    reads.clear()
    pd.testing.assert_frame_equal(index.load(store), expected)
    assert {(file, "a"), (file, "b")} <= set(reads)
    reads.clear()
    pd.testing.assert_frame_equal(index.load(store), expected)
    assert reads == []


@pytest.mark.usefixtures("settled")
@pytest.mark.parametrize("name", FORGED)
def test_an_index_that_somebody_else_wrote_counts_as_none(
    indexed: Path, reads: list[tuple[str, str]], name: str
) -> None:
    file, change = FORGED[name]
    forge(indexed / ".index" / f"{file}.index", change)
    check_ignored_and_rebuilt(indexed, file, reads)


@pytest.mark.usefixtures("settled")
@pytest.mark.parametrize(
    "metadata",
    [
        "{", "[3]", "3", "[3, 1]", "[3, [[1, 2]]]", '[3, [[["tags", "note"], ["text"]]]]', "[" * 50_000,
        '[3, [[["tags", "note"], ["text", "colour"]]]]', '[3, [[["note", "tags"], ["text", "text"]]]]',
        '[3, [[["tags", "note"], [["text"], "text"]]]]', '[3, [[["tags", "note", "more"], ["text", "text", "none"]]]]',
    ],
)  # fmt: skip
def test_an_index_with_other_shapes_counts_as_none(indexed: Path, reads: list[tuple[str, str]], metadata: str) -> None:
    forge(indexed / ".index" / f"{ANNOTATIONS}.index", metadata=metadata)
    check_ignored_and_rebuilt(indexed, ANNOTATIONS, reads)


@pytest.mark.usefixtures("settled")
def test_an_index_with_a_known_column_of_another_kind_counts_as_none(
    indexed: Path, reads: list[tuple[str, str]]
) -> None:
    path = indexed / ".index" / f"{SUMMARY}.index"
    version, ((names, kinds),) = shapes_of(path.read_bytes())
    kinds[names.index("psnr")] = "text"

    def change(table: pa.Table) -> pa.Table:
        number = table.schema.get_field_index("float psnr")
        return table.set_column(number, "text psnr", pa.array(["high", "low"]))

    forge(path, change, json.dumps([version, [[names, kinds]]]))
    check_ignored_and_rebuilt(indexed, SUMMARY, reads)


@pytest.mark.usefixtures("settled")
def test_an_index_with_damaged_pages_counts_as_none(indexed: Path, reads: list[tuple[str, str]]) -> None:
    path = indexed / ".index" / f"{SUMMARY}.index"
    data = bytearray(path.read_bytes()[4:])
    for column in pq.read_metadata(pa.BufferReader(data)).row_group(0).to_dict()["columns"]:
        if column["path_in_schema"] == "float psnr":
            start = column["dictionary_page_offset"] or column["data_page_offset"]
            data[start : start + column["total_compressed_size"]] = bytes(column["total_compressed_size"])
    path.write_bytes(zlib.crc32(data).to_bytes(4, "little") + data)
    check_ignored_and_rebuilt(indexed, SUMMARY, reads)


@pytest.mark.usefixtures("settled")
def test_what_a_killed_writer_left_goes_and_what_somebody_writes_stays(tmp_path: Path) -> None:
    write(tmp_path, "a", psnr=1.0)
    (tmp_path / ".index").mkdir()
    left, written = (tmp_path / ".index" / f".{SUMMARY}.index.{nonce}.tmp" for nonce in ("0a", "0b"))
    for path in (left, written):
        path.touch()
    os.utime(left, (0, 0))
    index.load(tmp_path)
    assert not left.exists()
    assert written.exists()


@pytest.mark.usefixtures("settled")
def test_an_index_of_another_format_is_built_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reads: list[tuple[str, str]]
) -> None:
    store = tmp_path / "runs"
    write(store, "a", psnr=1.0)
    with monkeypatch.context() as older:
        older.setattr(index_file, "FORMAT", index_file.FORMAT - 1)
        index.load(store)
    reads.clear()
    for _ in range(2):
        assert index.load(store)["psnr"].tolist() == [1.0]
    assert reads == [(STATUS, "a"), (SUMMARY, "a")]


@pytest.mark.usefixtures("settled")
def test_the_index_of_a_store_that_cannot_be_written_lies_in_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reads: list[tuple[str, str]]
) -> None:
    store = tmp_path / "runs"
    write(store, "a", psnr=1.0)
    monkeypatch.setattr(locations.os, "access", lambda path, mode: False)
    for _ in range(2):
        assert index.load(store)["psnr"].tolist() == [1.0]
    assert len(reads) == 2
    assert not (store / ".index").exists()
    assert len(list((tmp_path / "cache" / "index").glob("*/*.index"))) == 2


@pytest.mark.usefixtures("settled")
def test_an_index_in_a_store_that_cannot_be_written_any_more_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reads: list[tuple[str, str]]
) -> None:
    store = tmp_path / "runs"
    write(store, "a", psnr=1.0)
    index.load(store)
    reads.clear()
    monkeypatch.setattr(locations.os, "access", lambda path, mode: False)
    assert index.load(store)["psnr"].tolist() == [1.0]
    assert reads == []


@pytest.mark.usefixtures("settled")
def test_without_any_place_for_an_index_all_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reads: list[tuple[str, str]]
) -> None:
    store = tmp_path / "runs"
    write(store, "a", psnr=1.0)
    (store / ".index").write_text("in the way")
    (tmp_path / "cache").write_text("in the way")
    for _ in range(2):
        assert index.load(store)["psnr"].tolist() == [1.0]
    assert len(reads) == 4


@pytest.mark.usefixtures("settled")
def test_nothing_is_written_through_a_link(tmp_path: Path) -> None:
    store = tmp_path / "runs"
    write(store, "a", psnr=1.0)
    (tmp_path / "elsewhere").mkdir()
    (store / ".index").symlink_to(tmp_path / "elsewhere")
    assert index.load(store)["psnr"].tolist() == [1.0]
    assert list((tmp_path / "elsewhere").iterdir()) == []


@pytest.mark.usefixtures("settled")
def test_several_who_refresh_at_once_all_see_the_truth(tmp_path: Path) -> None:
    store = tmp_path / "runs"
    for number in range(20):
        write(store, f"r{number:02d}", psnr=float(number))
    start = threading.Barrier(4)

    def look(turn: int) -> list[pd.DataFrame]:
        start.wait()
        return [index.load(store) for _ in range(5)]

    for turn in range(3):
        write(store, "r00", psnr=100.0 + turn)
        with ThreadPoolExecutor(4) as pool:
            frames = [frame for part in pool.map(look, range(4)) for frame in part]
        for frame in frames:
            assert frame["psnr"].tolist() == [100.0 + turn, *map(float, range(1, 20))]
    assert not list((store / ".index").glob("*.tmp"))
