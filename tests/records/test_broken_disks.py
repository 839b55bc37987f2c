"""Disks that are full, read-only or gone, and stores that are not folders."""

import errno
import os
import shutil
import time

import pytest

from qnerf import records
from qnerf.records import RunStore, StoreError
from tests.helpers.stores import CONFIG, claimed


def test_a_full_disk(store_, monkeypatch):
    run = claimed(store_)
    run.log(0, 0.0, {"loss": 1.0})
    run.save_checkpoint({"step": 0})
    content = {path: path.read_bytes() for path in run.dir.rglob("*") if path.is_file()}

    def full(handle):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    run.log(1, 0.0, {"loss": 1.0})
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        for write in (run.flush, lambda: run.save_checkpoint({"step": 1}), lambda: run.write_summary({"psnr": 1})):
            with pytest.raises(StoreError, match=r"cannot write: No space left on device$"):
                write()
    assert {path: path.read_bytes() for path in run.dir.rglob("*") if path.is_file()} == content
    run.finish()
    assert len(records.read_metrics(run.dir)) == 2


def test_an_error_in_the_background_reaches_the_training_loop(tmp_path, monkeypatch):
    run = claimed(RunStore(tmp_path, every=0.01))

    def refused(*_, **__):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    def train():
        with run:
            end = time.monotonic() + 20
            step = 0
            while time.monotonic() < end:
                run.log(step, 0.0, {"loss": 1.0})
                step += 1
                time.sleep(0.001)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", refused)
        with pytest.raises(StoreError, match=r"cannot write: Read-only file system$"):
            train()
    assert records.state(run.dir) == "interrupted"  # not even the failure could be written
    again = claimed(RunStore(tmp_path))
    assert again.resumed
    again.interrupt()


def test_the_store_is_removed_under_a_running_job(store_):
    run = claimed(store_)
    run.log(0, 0.0, {"loss": 1.0})
    shutil.rmtree(store_.root)
    with pytest.raises(StoreError, match="folder was removed or moved while the run was writing"):
        run.flush()
    with pytest.raises(StoreError, match="folder was removed"):
        run.finish()
    assert not store_.root.exists()


def test_a_store_that_cannot_be(tmp_path):
    (tmp_path / "file").write_text("")
    for root in (tmp_path / "file", tmp_path / "file" / "runs"):
        with pytest.raises(StoreError, match="cannot create the run's folder"):
            RunStore(root).claim("a", CONFIG)
    (tmp_path / "a").write_text("")
    with pytest.raises(StoreError, match="cannot create the run's folder"):
        RunStore(tmp_path).claim("a", CONFIG)
