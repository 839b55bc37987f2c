"""The index on disk: damaged, in another format, not writable, refreshed by several processes at once."""

import os
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pandas as pd
import pytest

from qnerf.records import index
from qnerf.records.index import index_file, locations
from qnerf.records.index.locations import STATUS, SUMMARY
from tests.helpers.summaries import write


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
        assert index_file.StoredIndex.load([store / ".index"], path.name).keys == ["a", "b"]


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
