"""Rows of metrics: logged, flushed, dropped after a checkpoint's step."""

import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qnerf import records
from qnerf.records import RunStore, StoreError, writer
from tests.helpers.processes import wait
from tests.helpers.stores import claimed


def test_metric_rows_are_read_as_they_were_logged(store_):
    run = claimed(store_)
    for step in range(5):
        run.log(step, 0.5 * step, {"loss": 1 / (step + 1), "psnr": float("nan") if step == 2 else step})
    run.log(5, 2.5, {"loss": torch.tensor(0.25), "flag": True})
    assert len(records.read_metrics(run.dir)) == 0
    run.flush()
    run.flush()
    frame = records.read_metrics(run.dir)
    assert len(frame) == 12
    assert frame["step"].tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5]
    assert frame.query("key == 'loss'")["value"].tolist() == [1, 1 / 2, 1 / 3, 1 / 4, 1 / 5, 0.25]
    assert np.isnan(frame["value"][5])
    assert frame["time_s"].tolist()[-1] == 2.5
    run.finish()


@pytest.mark.parametrize("value", ["3", None, [1.0], torch.zeros(2)])
def test_metric_rows_refuse_what_is_no_number(store_, value):
    run = claimed(store_)
    with pytest.raises(ValueError, match="log: psnr expects a number, got"):
        run.log(0, 0.0, {"loss": 1.0, "psnr": value})
    run.finish()
    assert len(records.read_metrics(run.dir)) == 0


def test_rows_reach_the_disk_by_themselves(tmp_path):
    run = claimed(RunStore(tmp_path, every=0.02))
    run.log(3, 0.0, {"loss": 1.0})
    before = records.read_status(run.dir)["heartbeat"]
    wait(lambda: len(records.read_metrics(run.dir)) == 1 and records.read_status(run.dir)["heartbeat"] != before)
    assert records.read_status(run.dir)["step"] == 3
    run.finish()


def test_metric_parts_close_and_stay(store_, monkeypatch):
    monkeypatch.setattr(writer, "PART_ROWS", 10)
    run = claimed(store_)
    for step in range(13):
        run.log(step, 0.0, {"a": step, "b": -step})
    run.flush()
    parts = sorted((run.dir / "metrics").iterdir())
    assert [pq.read_metadata(part).num_rows for part in parts] == [10, 10, 6]
    closed = [part.stat().st_ino for part in parts[:2]]
    for step in range(13, 20):
        run.log(step, 0.0, {"a": step, "b": -step})
        run.flush()
    assert [part.stat().st_ino for part in parts[:2]] == closed
    frame = records.read_metrics(run.dir)
    assert frame["value"].tolist() == [sign * step for step in range(20) for sign in (1, -1)]
    run.finish()


@settings(max_examples=15)
@given(st.integers(1, 7), st.integers(0, 30), st.integers(-1, 32), st.integers(0, 12))
def test_resume_drops_exactly_what_lies_beyond(tmp_path_factory, part_rows, steps, last_step, more):
    store = RunStore(tmp_path_factory.mktemp("runs"), every=60)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, "PART_ROWS", part_rows)
        run = claimed(store)
        for step in range(steps):
            run.log(step, 0.0, {"a": step, "b": -step})
        run.interrupt()
        again = claimed(store)
        assert again.resumed
        again.resume(last_step)
        expected = list(range(min(steps, last_step + 1)))
        assert records.read_metrics(run.dir)["step"].tolist() == [step for step in expected for _ in "ab"]
        for step in range(len(expected), len(expected) + more):
            again.log(step, 0.0, {"b": -step, "a": step})
        again.finish()
    frame = records.read_metrics(run.dir)
    assert frame.query("key == 'a'")["value"].tolist() == list(range(len(expected) + more))
    assert not frame.duplicated(["step", "key"]).any()


def test_a_damaged_part_is_named_and_without_it_the_run_goes_on(store_, monkeypatch):
    monkeypatch.setattr(writer, "PART_ROWS", 10)
    run = claimed(store_)
    for step in range(25):
        run.log(step, 0.0, {"a": step})
    run.interrupt()
    part = run.dir / "metrics" / "part-00001.parquet"
    part.write_bytes(part.read_bytes()[:-20])
    run = claimed(store_)
    with pytest.raises(StoreError, match=r"part-00001\.parquet: damaged: .*; delete this file"), run:
        run.resume(22)
    part.unlink()
    run = claimed(store_)
    run.resume(22)
    run.log(23, 0.0, {"a": 23})
    run.finish()
    assert records.read_metrics(run.dir)["step"].tolist() == [*range(10), *range(20, 24)]


def test_copy_of_a_sync_program_is_ignored(store_):
    run = claimed(store_)
    run.log(0, 0.0, {"loss": 1.0})
    run.save_checkpoint({"step": 0})
    run.interrupt()
    part = run.dir / "metrics" / "part-00000.parquet"
    shutil.copy(part, part.with_name("part-00000 (1).parquet"))
    again = claimed(store_)
    again.resume(0)
    again.interrupt()
    assert len(records.read_metrics(run.dir)) == 1
