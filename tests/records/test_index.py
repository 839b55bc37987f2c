"""The table of all runs is complete and correct, with an index as without one."""

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from qnerf.records import RunStore, index, summary_row
from qnerf.records.index import entries, locations
from qnerf.records.index.locations import ANNOTATIONS, STATUS, SUMMARY
from tests.helpers.summaries import CONFIG, load_without_index, put, write


def test_a_row_is_what_the_run_wrote(tmp_path: Path) -> None:
    claim = RunStore(tmp_path / "runs").claim("a", CONFIG | {"seed": 7}, columns={"field": "qcolor"})
    assert claim.run is not None
    claim.run.log(4, 0.5, {"loss": 1.0})
    claim.run.finish({"psnr": 21.5, "params.total": 491})
    (claim.dir / ANNOTATIONS).write_text('{"tags": ["good", "baseline"], "note": "see the ä"}')
    frame = index.load(tmp_path / "runs")
    (row,) = frame.to_dict("records")
    expected = {
        "run_id": "a", "state": "finished", "path": str(claim.dir), "step": 4, "tags": ("baseline", "good"),
        "note": "see the ä", "field": "qcolor", "seed": 7, "train.lr": 0.01, "psnr": 21.5, "params.total": 491,
    }  # fmt: skip
    assert {key: row[key] for key in expected} == expected
    assert row["heartbeat"] >= row["created"] > 1e9
    assert pd.isna(row["error"])
    assert row["experiment"] is None
    assert frame.columns.is_unique
    summary = pd.read_parquet(claim.dir / SUMMARY)
    assert set(frame.columns) == set(summary.columns) | set(index.RUN_COLUMNS)


def test_the_state_is_the_true_one(tmp_path: Path) -> None:
    store = RunStore(tmp_path / "runs")
    alive = store.claim("alive", CONFIG).run
    dead = store.claim("dead", CONFIG).run
    failed = store.claim("failed", CONFIG).run
    assert alive is not None
    assert dead is not None
    assert failed is not None
    failed.fail("out of memory")
    dead._stop()
    dead._closed = True
    for path in [dead.dir / "status.json", *dead.dir.glob("owner/*.json")]:
        path.write_text(json.dumps(json.loads(path.read_text()) | {"started": "1"}))
    for _ in range(2):
        frame = index.load(store.root).set_index("run_id")
        assert frame["state"].to_dict() == {"alive": "running", "dead": "interrupted", "failed": "failed"}
        assert frame["error"]["failed"] == "out of memory"
    alive.finish()
    assert index.load(store.root).set_index("run_id")["state"]["alive"] == "finished"


def test_runs_are_shown_whatever_is_wrong_with_them(tmp_path: Path) -> None:
    store = tmp_path / "runs"
    write(store, "good", psnr=20.0)
    put(write(store, "damaged") / SUMMARY, b"PAR1 and no more")
    (write(store, "bare", state="failed") / SUMMARY).unlink()
    (write(store, "mute") / STATUS).unlink()
    put(write(store, "odd") / STATUS, b"[1, 2]")
    put(write(store, "noted") / ANNOTATIONS, b'{"tags": "no list", "note": 5}')
    put(store / "configured" / "config.yaml", b"seed: 0\n")
    (write(store, "linked") / SUMMARY).unlink()
    (store / "linked" / SUMMARY).symlink_to(store / "good" / SUMMARY)
    (store / "empty").mkdir()
    (store / "stray.txt").write_text("")
    (store / ".tmp" / "new-x").mkdir(parents=True)
    frame = index.load(store).set_index("run_id")
    assert frame["state"].to_dict() == {
        "bare": "failed", "configured": "interrupted", "damaged": "damaged", "good": "finished", "linked": "damaged",
        "mute": "interrupted", "noted": "finished", "odd": "damaged",
    }  # fmt: skip
    assert frame["error"]["damaged"].startswith("summary.parquet: damaged: ")
    assert "is a link" in frame["error"]["linked"]
    assert frame["psnr"].notna().sum() == 1
    assert set(frame["tags"]) == {()}
    assert frame["note"].isna().all()
    pd.testing.assert_frame_equal(frame, index.load(store).set_index("run_id"))


def test_there_may_be_no_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    (tmp_path / "empty").mkdir()
    for store in ("runs", "empty"):  # the default store, before anybody has trained
        frame = index.load(store)
        assert frame.empty
        assert {"run_id", "state", "path"} <= set(frame.columns)
    for store, reason in (("absent", "no such folder"), ("file", "not a folder")):
        with pytest.raises(ValueError, match=f"{store}: {reason}"):
            index.load(tmp_path / store)


def test_values_of_several_types_share_a_column(tmp_path: Path) -> None:
    store = tmp_path / "runs"
    options = [
        {"a": 1, "b": 1, "c": True, "d": None, "e": 2**53 + 1},
        {"a": 0.5, "b": "auto", "c": 2, "d": None, "e": 0.5},
        {"a": None, "b": None, "c": None, "f": "x"},
    ]
    for number, config in enumerate(options):
        write(store, f"r{number}", config=config)
    frame = index.load(store)
    assert frame["a"].tolist()[:2] == [1.0, 0.5]
    assert frame["a"].dtype == "float64"
    assert frame["b"].tolist()[:2] == ["1", "auto"]
    assert frame["c"].tolist()[:2] == ["true", "2"]
    assert frame["d"].tolist() == [None] * 3
    assert frame["e"].tolist()[:2] == [str(2**53 + 1), "0.5"]  # no float64 is that number
    assert frame["f"].tolist()[2] == "x"
    assert frame.iloc[2][["a", "b", "c"]].isna().all()
    # without the run of another type, a column has its own type again
    shutil.rmtree(store / "r1")
    frame = index.load(store)
    assert frame["b"].tolist()[0] == 1
    assert frame["c"].tolist()[0] is True


@pytest.mark.usefixtures("settled")
def test_only_what_changed_is_read_again(tmp_path: Path, reads: list[tuple[str, str]]) -> None:
    store = tmp_path / "runs"
    for name in "abc":
        write(store, name, psnr=1.0)
    index.load(store)
    assert sorted(reads) == sorted((file, name) for file in (SUMMARY, STATUS) for name in "abc")
    reads.clear()
    index.load(store)
    assert reads == []
    put(store / "b" / STATUS, b'{"state": "failed", "error": "why"}')
    put(store / "c" / ANNOTATIONS, b'{"tags": ["x"]}')
    shutil.rmtree(store / "a")
    frame = index.load(store)
    assert reads == [(STATUS, "b"), (SUMMARY, "b"), (ANNOTATIONS, "c")]
    assert frame["run_id"].tolist() == ["b", "c"]
    assert frame["state"].tolist() == ["failed", "finished"]
    assert frame["error"].tolist()[0] == "why"
    assert frame["tags"].tolist() == [(), ("x",)]
    reads.clear()
    write(store, "a", psnr=2.0)
    assert index.load(store)["psnr"].tolist() == [2.0, 1.0, 1.0]
    assert {run for _, run in reads} == {"a"}


def test_what_has_just_changed_is_read_every_time(tmp_path: Path, reads: list[tuple[str, str]]) -> None:
    store = tmp_path / "runs"
    write(store, "a", psnr=1.0)
    for _ in range(3):
        index.load(store)
    assert reads == [(STATUS, "a"), (SUMMARY, "a")] * 3


def test_a_change_within_the_step_of_a_coarse_clock_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Same size, times and inode, as on a file system that counts in seconds or reuses inodes."""
    lstat = os.lstat

    def coarse(path: str) -> Any:
        status = lstat(path)
        return SimpleNamespace(
            st_mtime=int(status.st_mtime), st_ctime=int(status.st_ctime), st_size=status.st_size,
            st_mtime_ns=0, st_ctime_ns=0, st_ino=1,
        )  # fmt: skip

    monkeypatch.setattr(locations.os, "lstat", coarse)
    store = tmp_path / "runs"
    for psnr in (1.0, 2.0, 3.0):
        write(store, "a", psnr=psnr)
        assert index.load(store)["psnr"].tolist() == [psnr]


@pytest.mark.usefixtures("settled")
def test_an_older_copy_put_back_with_its_times_is_seen(tmp_path: Path) -> None:
    store = tmp_path / "runs"
    path = write(store, "a", psnr=1.0) / SUMMARY
    shutil.copy2(path, tmp_path / "copy.parquet")
    before = path.stat()
    write(store, "a", psnr=2.0)
    assert path.stat().st_size == before.st_size
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert index.load(store)["psnr"].tolist() == [2.0]
    with open(path, "r+b") as file:
        file.write((tmp_path / "copy.parquet").read_bytes())
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert index.load(store)["psnr"].tolist() == [1.0]


operations = st.lists(
    st.tuples(
        st.sampled_from(["write", "write", "write", "remove", "damage", "strip", "tag", "status"]),
        st.sampled_from("abcd"),
        st.sampled_from([1, 2**60, 0.5, "text", True, None, [1], "1"]),
        st.booleans(),
    ),
    min_size=1,
    max_size=8,
)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(operations)
@pytest.mark.usefixtures("settled")
def test_a_store_that_changes_reads_as_if_read_for_the_first_time(
    tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[str, str, Any, bool]]
) -> None:
    store = tmp_path_factory.mktemp("store") / "runs"
    store.mkdir()
    for operation, name, value, look in steps:
        run = store / name
        if operation == "write":
            write(store, name, config={"odd": value} if look else {"other": value})
        elif operation == "remove":
            shutil.rmtree(run, ignore_errors=True)
        elif operation == "damage":
            put(run / SUMMARY, b"damaged")
        elif operation == "strip":
            (run / SUMMARY).unlink(missing_ok=True)
        elif operation == "tag":
            put(run / ANNOTATIONS, json.dumps({"tags": [str(value)], "note": str(value)}).encode())
        else:
            put(run / STATUS, json.dumps({"state": "failed", "error": str(value)}).encode())
        if look:
            index.load(store)
    pd.testing.assert_frame_equal(index.load(store), load_without_index(store))


@pytest.mark.usefixtures("settled")
@pytest.mark.parametrize("warm", [False, True])
def test_columns_that_are_asked_for(tmp_path: Path, warm: bool) -> None:
    store = tmp_path / "runs"
    write(store, "a", psnr=1.0)
    put(write(store, "b") / SUMMARY, b"damaged")
    if warm:
        index.load(store)
    wanted = ["psnr", "run_id", "never there", "state", "train.lr", "tags"]
    frame = index.load(store, wanted)
    assert list(frame.columns) == ["psnr", "run_id", "state", "train.lr", "tags"]
    pd.testing.assert_frame_equal(frame, index.load(store)[list(frame.columns)])
    assert frame["state"].tolist() == ["finished", "damaged"]
    assert index.columns(store) == list(index.load(store).columns)


@pytest.mark.usefixtures("settled")
def test_progress_is_told_of_what_is_read(tmp_path: Path) -> None:
    store = tmp_path / "runs"
    for name in "abc":
        write(store, name)
    calls: list[tuple[str, int, int]] = []
    index.load(store, progress=lambda *step: calls.append(step))
    assert [step for step in calls if step[0] == SUMMARY] == [(SUMMARY, done, 3) for done in range(3)]
    calls.clear()
    index.load(store, progress=lambda *step: calls.append(step))
    assert calls == []


def forged(names: list, types: list, values: list) -> bytes:
    """A summary whose footer contradicts its columns, with the right checksum."""
    data = summary_row.encode(pa.table({"psnr": [1.0]}))
    start = data.index(b'["qnerf.row"')
    end = data.index(b"]]", start) + 2
    entry = json.dumps(["qnerf.row", data[start + 14 : start + 22].decode(), names, types, values]).encode()
    return data[:start] + entry + data[end:]


@pytest.mark.parametrize(
    ("names", "types", "values"),
    [
        (["psnr"], ["double"], ["text"]),
        (["psnr"], ["int64"], [2**70]),
        (["psnr"], ["string"], [["list"]]),
        (["psnr"], ["string"], ["\ud800"]),
        (["psnr"], ["double"], []),
        ([["psnr"]], ["double"], [1.0]),
        ([5], ["double"], [1.0]),
        (["psnr"], [{}], [1.0]),
        (5, 5, 5),
    ],
    ids=["text", "large", "list", "half a character", "short", "nested", "number", "dict", "no lists"],
)
def test_a_forged_summary_spoils_only_its_own_row(tmp_path: Path, names: Any, types: Any, values: Any) -> None:
    store = tmp_path / "runs"
    write(store, "good", psnr=20.0)
    put(write(store, "bad") / SUMMARY, forged(names, types, values))
    frame = index.load(store)
    assert frame["state"].tolist() == ["damaged", "finished"]
    assert "damaged" in frame["error"].tolist()[0]
    assert frame["psnr"].tolist()[1] == 20.0


def test_types_that_a_run_does_not_write_are_read(tmp_path: Path) -> None:
    store = tmp_path / "runs"
    write(store, "a")
    small = pa.table({"int": pa.array([1], pa.int8()), "day": pa.array([0], pa.date32())})
    put(store / "a" / SUMMARY, summary_row.encode(small.select(["int"])))
    assert index.load(store)["int"].tolist() == [1]
    sink = pa.BufferOutputStream()
    pa.parquet.write_table(small, sink)
    put(store / "a" / SUMMARY, sink.getvalue().to_pybytes())
    (row,) = index.load(store).to_dict("records")
    assert (row["int"], row["day"]) == (1, "1970-01-01")


def test_a_run_that_goes_while_it_is_read_is_no_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = tmp_path / "runs"
    for name in "ab":
        write(store, name)
    scan = locations.FolderLocation.scan

    def scan_then_remove(location: locations.FolderLocation) -> locations.Stamps:
        stamps = scan(location)
        shutil.rmtree(store / "a")
        return stamps

    monkeypatch.setattr(locations.FolderLocation, "scan", scan_then_remove)
    assert index.load(store)["run_id"].tolist() == ["b"]


@pytest.mark.usefixtures("settled")
@pytest.mark.parametrize("late", [STATUS, SUMMARY])
def test_a_run_that_ends_while_it_is_read_is_shown_as_it_was_or_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, late: str
) -> None:
    """Never finished with the numbers from before, nor interrupted because its owner has just released it."""
    store = RunStore(tmp_path / "runs")
    run = store.claim("a", CONFIG).run
    assert run is not None
    run.write_summary({"psnr": 1.0})
    index.load(store.root)
    run.status(step=5)
    read = locations.FolderLocation.read

    def ending(location: locations.FolderLocation, file: str, runs: list[str]) -> Iterator[Any]:
        if file == late and not run._closed:
            run.finish({"psnr": 2.0})
        return read(location, file, runs)

    monkeypatch.setattr(locations.FolderLocation, "read", ending)
    (row,) = index.load(store.root)[["state", "psnr"]].to_dict("records")
    assert run._closed
    assert row in (
        {"state": "running", "psnr": 1.0},
        {"state": "running", "psnr": 2.0},
        {"state": "finished", "psnr": 2.0},
    )
    assert index.load(store.root)["state"].tolist() == ["finished"]


def test_what_cannot_be_read_now_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = tmp_path / "runs"
    write(store, "a", psnr=1.0)

    def broken(path: Path, most: int) -> bytes:
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as context:
        context.setattr(locations, "read_bytes", broken)
        frame = index.load(store)
    assert frame["state"].tolist() == ["damaged"]
    assert frame["error"].tolist()[0].endswith("summary.parquet: cannot read: Permission denied")
    assert index.load(store)["state"].tolist() == ["finished"]
    assert entries.DAMAGED not in index.load(store).columns
