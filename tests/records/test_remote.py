"""A store behind a URL that fsspec reads."""

import shutil
from pathlib import Path

import fsspec
import pandas as pd
import pytest

from qnerf.records import RunStore, StoreError, index, read_metrics
from tests.helpers.stores import claimed


def test_store_behind_a_url_reads_as_the_same_folder(tmp_path: Path) -> None:
    store = RunStore(tmp_path / "runs")
    run = claimed(store, "a")
    for step in range(3):
        run.log(step, 0.1, {"loss": 1.0})
    run.finish({"psnr": 20.0})
    running = claimed(store, "b")
    shutil.copytree(store.root / "a", store.root / "c")
    (store.root / "c" / "summary.parquet").write_bytes(b"PAR1")
    storage = fsspec.filesystem("memory")
    storage.put(str(store.root), "/bucket/runs", recursive=True)
    try:
        here, there = index.load(store.root), index.load("memory://bucket/runs/")
        assert there["path"].tolist() == [f"memory://bucket/runs/{name}" for name in "abc"]
        assert there["state"].tolist() == ["finished", "running", "damaged"]
        changing = ["path", "error", "heartbeat"]
        pd.testing.assert_frame_equal(there.drop(columns=changing), here.drop(columns=changing))
        pd.testing.assert_frame_equal(index.metrics("memory://bucket/runs/a"), read_metrics(store.root / "a"))
        assert index.load("memory://bucket/nothing").empty
    finally:
        storage.rm("/bucket", recursive=True)
        running.finish()


def test_unknown_storage_is_one_line() -> None:
    with pytest.raises(StoreError, match=r"nonsense://bucket: cannot read: .*nonsense") as error:
        index.load("nonsense://bucket")
    assert "\n" not in str(error.value)
