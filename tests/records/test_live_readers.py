"""The store read run by run, and as one table, while another process writes it."""

from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

from qnerf import records
from qnerf.records import index
from qnerf.records.read import read_evaluation
from tests.helpers.processes import start
from tests.helpers.writing_runs import RUNS, STEPS, VIEWS

COLUMNS = ["run_id", "state", "psnr", "field", "option"]


def folders(store: Path) -> list[Path]:
    return sorted(path for path in store.glob("*") if not path.name.startswith("."))


def with_the_readers(store: Path) -> pd.DataFrame:
    for run in folders(store):
        metrics = records.read_metrics(run)
        assert metrics["step"].tolist() == [step for step in range(len(metrics) // 2) for _ in range(2)]
        assert len(read_evaluation(run)) in (0, VIEWS)
    return pd.DataFrame([records.read_summary(run) for run in folders(store)], columns=COLUMNS)


def with_the_index(store: Path) -> pd.DataFrame:
    frame = index.load(store)
    assert not set(frame["state"]) - {"running", "finished"}
    return frame


@pytest.mark.parametrize("read", [with_the_readers, with_the_index], ids=lambda read: read.__name__)
def test_a_store_is_whole_at_every_moment(tmp_path: Path, read: Callable[[Path], pd.DataFrame]) -> None:
    store = tmp_path / "runs"
    process = start("writing_runs", str(store))
    seen: list[int] = []
    try:
        while process.poll() is None:
            if not folders(store):
                continue
            frame = read(store).set_index("run_id")
            seen.append(len(frame))
            finished = frame[frame["state"] == "finished"]
            assert (finished["psnr"] == STEPS).all()
            assert set(frame["field"]) == {"qcolor"}
            assert sorted(frame.index) == [f"r{number:02d}" for number in range(len(frame))]
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0
    assert seen == sorted(seen)
    assert len(seen) > 3
    frame = read(store)
    assert (len(frame), set(frame["state"])) == (RUNS, {"finished"})
    assert sorted(frame["option"].dropna()) == [0.5] * 4 + [2.0] * 4
