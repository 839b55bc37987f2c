"""The table of all runs is complete and correct, with an index as without one."""

import json
import shutil
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from qnerf import records
from qnerf.records import RunStore, files, index, schemas
from qnerf.records.parquet import encode
from tests.helpers.stores import vanish

CONFIG = {"seed": 0, "train": {"lr": 0.01, "steps": 10}, "experiment": None}
TYPES = {"seed": "int", "train.lr": "float", "train.steps": "int"}
SUMMARY, STATUS = "summary.parquet", "status.json"


def put(path, data):
    path.parent.mkdir(parents=True, exist_ok=True)
    files.replace(path, data, durable=False)


def write(store, name, state="finished", config=None, **results):
    """Writes the files of a run that the index reads, as the writer would."""
    results = {"run_id": name, "state": state} | results
    put(store / name / SUMMARY, encode(schemas.summary(results, CONFIG | (config or {}), TYPES)))
    status = {"state": state, "step": 10, "created": 100.0, "heartbeat": 110.0, "error": None}
    put(store / name / STATUS, json.dumps(status).encode())
    return store / name


def test_row_is_what_the_run_wrote(tmp_path):
    claim = RunStore(tmp_path / "runs").claim("a", CONFIG | {"seed": 7}, columns={"field": "qcolor"})
    claim.run.log(4, 0.5, {"loss": 1.0})
    claim.run.finish({"psnr": 21.5, "params.total": 491})
    frame = index.load(tmp_path / "runs")
    (row,) = frame.to_dict("records")
    expected = {
        "run_id": "a", "state": "finished", "path": str(claim.dir), "step": 4,
        "field": "qcolor", "seed": 7, "train.lr": 0.01, "psnr": 21.5, "params.total": 491,
    }  # fmt: skip
    assert {key: row[key] for key in expected} == expected
    assert row["heartbeat"] >= row["created"] > 1e9
    assert pd.isna(row["error"])
    assert frame.columns.is_unique
    assert set(frame.columns) == set(pd.read_parquet(claim.dir / SUMMARY).columns) | set(index.RUN_COLUMNS) | {
        "scene_name"
    }


def test_state_is_the_true_one(tmp_path):
    store = RunStore(tmp_path / "runs")
    alive, dead, failed = (store.claim(name, CONFIG).run for name in ("alive", "dead", "failed"))
    assert dead is not None
    failed.fail("out of memory")
    vanish(dead)
    for _ in range(2):
        frame = index.load(store.root).set_index("run_id")
        assert frame["state"].to_dict() == {"alive": "running", "dead": "interrupted", "failed": "failed"}
        assert frame["error"]["failed"] == "out of memory"
    alive.finish()
    assert index.load(store.root).set_index("run_id")["state"]["alive"] == "finished"


def test_damaged_runs_are_rows(tmp_path):
    store = tmp_path / "runs"
    write(store, "good", psnr=20.0)
    put(write(store, "damaged") / SUMMARY, b"PAR1 and no more")
    (write(store, "bare", state="failed") / SUMMARY).unlink()
    (write(store, "mute") / STATUS).unlink()
    put(write(store, "odd") / STATUS, b"[1, 2]")
    put(store / "configured" / "config.yaml", b"seed: 0\n")
    pq.write_table(pa.table({"psnr": [[1.0]]}), write(store, "typed") / SUMMARY)
    (store / "empty").mkdir()
    (store / "stray.txt").write_text("")
    (store / ".deleted-x" / "owner").mkdir(parents=True)
    frame = index.load(store).set_index("run_id")
    assert frame["state"].to_dict() == {
        "bare": "failed", "configured": "interrupted", "damaged": "damaged", "good": "finished",
        "mute": "interrupted", "odd": "damaged", "typed": "damaged",
    }  # fmt: skip
    assert "summary.parquet: damaged: " in frame["error"]["damaged"]
    assert frame["psnr"].notna().sum() == 1
    pd.testing.assert_frame_equal(frame, index.load(store).set_index("run_id"))


def test_store_may_be_absent(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    for store in ("runs", "empty"):  # the default store, before anybody has trained
        frame = index.load(store)
        assert frame.empty
        assert {"run_id", "state", "path"} <= set(frame.columns)
    with pytest.raises(ValueError, match="absent: no such folder"):
        index.load(tmp_path / "absent")


def test_values_of_several_types_share_a_column(tmp_path):
    """Runs of another version may have declared another type."""
    store = tmp_path / "runs"
    for name, columns in {
        "r0": {"a": [1], "b": [1], "c": [True], "d": pa.nulls(1), "e": [2**53 + 1]},
        "r1": {"a": [0.5], "b": ["auto"], "c": [2], "d": pa.nulls(1), "e": [0.5]},
        "r2": {"f": pa.array([0], pa.date32())},
    }.items():
        write(store, name)
        pq.write_table(pa.table(columns | {"lpips": pa.nulls(1)}), store / name / SUMMARY)
    frame = index.load(store)
    assert frame["lpips"].dtype == float  # declared, even without a value
    assert frame["a"].tolist()[:2] == [1.0, 0.5]
    assert frame["b"].tolist()[:2] == ["1", "auto"]
    assert frame["c"].tolist()[:2] == ["true", "2"]
    assert frame["d"].tolist() == [None] * 3
    assert frame["e"].tolist()[:2] == [2.0**53, 0.5]
    assert frame["f"].tolist()[2] == "1970-01-01"
    assert frame.iloc[2][["a", "b", "c"]].isna().all()


def test_only_what_changed_is_read_again(tmp_path, reads):
    store = tmp_path / "runs"
    for name in "abcd":
        write(store, name, psnr=1.0)
    index.load(store)
    assert reads == list("abcd")
    reads.clear()
    index.load(store)
    assert reads == []
    put(store / "b" / STATUS, b'{"state": "failed", "error": "why"}')
    shutil.rmtree(store / "a")
    frame = index.load(store)
    assert reads == ["b"]
    assert frame["run_id"].tolist() == ["b", "c", "d"]
    assert frame["state"].tolist() == ["failed", "finished", "finished"]
    assert frame["error"].tolist()[0] == "why"
    (store / index.INDEX).write_bytes(b"damaged")
    pd.testing.assert_frame_equal(index.load(store), frame)


operations = st.lists(
    st.tuples(
        st.sampled_from(["write", "write", "write", "remove", "damage", "strip", "status"]),
        st.sampled_from("abcd"),
        st.sampled_from([1, 0.5, "text", True, None, [1]]),
        st.booleans(),
    ),
    min_size=1,
    max_size=8,
)


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(operations)
def test_store_that_changes_reads_as_if_read_for_the_first_time(tmp_path_factory, steps):
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
        else:
            put(run / STATUS, json.dumps({"state": "failed", "error": str(value)}).encode())
        if look:
            index.load(store)
    warm = index.load(store)
    shutil.rmtree(store / ".index", ignore_errors=True)
    names = set(index.load(store).columns) | set(warm.columns)
    cold = index.load(store)
    assert names == set(cold.columns) | {name for name in warm.columns if warm[name].isna().all()}
    pd.testing.assert_frame_equal(warm[list(cold.columns)], cold, check_dtype=False)


def test_columns_that_are_asked_for(tmp_path):
    store = tmp_path / "runs"
    write(store, "a", psnr=1.0)
    put(write(store, "b") / SUMMARY, b"damaged")
    frame = index.load(store, ["psnr", "run_id", "never there", "state", "train.lr"])
    assert list(frame.columns) == ["psnr", "run_id", "state", "train.lr"]
    pd.testing.assert_frame_equal(frame, index.load(store)[list(frame.columns)])
    assert frame["state"].tolist() == ["finished", "damaged"]


def test_run_that_goes_while_it_is_read_is_no_row(tmp_path, monkeypatch):
    store = tmp_path / "runs"
    for name in "ab":
        write(store, name)
    scan = index.scan

    def scan_then_remove(root):
        stamps = scan(root)
        shutil.rmtree(store / "a")
        return stamps

    monkeypatch.setattr(index, "scan", scan_then_remove)
    assert index.load(store)["run_id"].tolist() == ["b"]


@pytest.mark.parametrize("moment", ["checked_status", "read_summary", "_frame"])
def test_run_that_ends_while_it_is_read_is_shown_as_it_was_or_as_it_is(tmp_path, monkeypatch, moment):
    """Never finished with the numbers from before, nor interrupted because its owner has just released it."""
    store = RunStore(tmp_path / "runs")
    run = store.claim("a", CONFIG).run
    run.write_summary({"psnr": 1.0})
    module = index if moment == "_frame" else records.read
    original = getattr(module, moment)

    def ending(*arguments):
        monkeypatch.undo()
        run.finish({"psnr": 2.0})
        return original(*arguments)

    monkeypatch.setattr(module, moment, ending)
    (row,) = index.load(store.root)[["state", "psnr"]].to_dict("records")
    assert run._closed
    assert (row["state"], row["psnr"]) in (("running", 1.0), ("running", 2.0), ("finished", 2.0))
    assert index.load(store.root)["state"].tolist() == ["finished"]


def test_index_tries_again_what_cannot_be_read_now(tmp_path, monkeypatch):
    store = tmp_path / "runs"
    write(store, "a", psnr=1.0)

    def broken(*_):
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as context:
        context.setattr(Path, "read_bytes", broken)
        frame = index.load(store)
    assert frame["state"].tolist() == ["damaged"]
    assert frame["error"].tolist()[0].endswith("cannot read: Permission denied")
    assert index.load(store)["state"].tolist() == ["finished"]
