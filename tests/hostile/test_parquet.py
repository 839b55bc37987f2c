"""Tables that are damaged or hold something else: one line that names the file."""

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from qnerf import records
from qnerf.records import StoreError
from tests.helpers.spoiled import interrupted

METRICS = {"step": [1], "time_s": [0.0], "key": ["a"], "value": [1.0]}


@pytest.mark.parametrize("data", [b"", b"PAR1", b"PAR1" + bytes(100) + b"PAR1", b"hello", bytes(2**16)])
def test_what_is_no_table(tmp_path: Path, data: bytes) -> None:
    run = interrupted(tmp_path)
    (run / "metrics" / "part-00000.parquet").write_bytes(data)
    (run / "summary.parquet").write_bytes(data)
    for reader, name in ((records.read_metrics, "part-00000"), (records.read_summary, "summary")):
        with pytest.raises(StoreError, match=rf"{name}\.parquet: damaged") as error:
            reader(run)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "columns",
    [
        {"step": [1]},
        {**METRICS, "more": [1]},
        METRICS | {"step": ["x"]},
        METRICS | {"value": [[1.0]]},
        METRICS | {"key": [{"a": 1}]},
    ],
    ids=["missing", "more", "text", "list", "struct"],
)
def test_other_columns(tmp_path: Path, columns: dict[str, list]) -> None:
    run = interrupted(tmp_path)
    pq.write_table(pa.table(columns), run / "metrics" / "part-00000.parquet")
    with pytest.raises(StoreError, match=r"part-00000\.parquet: damaged") as error:
        records.read_metrics(run)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("rows", [0, 2])
def test_a_summary_has_one_row(tmp_path: Path, rows: int) -> None:
    run = interrupted(tmp_path)
    pq.write_table(pa.table({"run_id": ["a"] * rows}), run / "summary.parquet")
    with pytest.raises(StoreError, match=f"expected one row, got {rows}"):
        records.read_summary(run)
