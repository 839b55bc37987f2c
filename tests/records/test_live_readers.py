"""The store read with pandas, pyarrow and DuckDB, and as one table, while another process writes it."""

from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pyarrow.dataset
import pyarrow.parquet as pq
import pytest

from qnerf.records import index
from tests.helpers.processes import start
from tests.helpers.writing_runs import RUNS, STEPS, VIEWS


def folders(store: Path) -> list[Path]:
    return sorted(path for path in store.glob("*") if not path.name.startswith("."))


def with_pandas(store: Path) -> pd.DataFrame:
    for run in folders(store):
        metrics = pd.read_parquet(run / "metrics")
        assert list(metrics.columns) == ["step", "time_s", "key", "value"]
        assert metrics["step"].tolist() == [step for step in range(len(metrics) // 2) for _ in range(2)]
        assert len(pd.read_parquet(run / "eval.parquet")) in (0, VIEWS)
    return pd.concat([pd.DataFrame(), *(pd.read_parquet(run / "summary.parquet") for run in folders(store))])


def with_pyarrow(store: Path) -> pd.DataFrame:
    for run in folders(store):
        metrics = pyarrow.dataset.dataset(run / "metrics").to_table(use_threads=False)
        assert metrics.num_rows % 2 == 0
    tables = [pq.ParquetFile(run / "summary.parquet").read(use_threads=False) for run in folders(store)]
    return pd.concat([pd.DataFrame(), *(table.to_pandas() for table in tables)])


def with_duckdb(store: Path) -> pd.DataFrame:
    duckdb = pytest.importorskip("duckdb")
    metrics = duckdb.sql(f"select filename, count(*) as n from '{store}/*/metrics/*.parquet' group by filename").df()
    assert (metrics["n"] % 2 == 0).all()
    return duckdb.sql(f"select * from read_parquet('{store}/*/summary.parquet', union_by_name=true)").df()


def with_the_index(store: Path) -> pd.DataFrame:
    frame = index.load(store)
    assert not set(frame["state"]) - {"running", "finished"}
    return frame


@pytest.mark.parametrize(
    "read", [with_pandas, with_pyarrow, with_duckdb, with_the_index], ids=lambda read: read.__name__
)
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
