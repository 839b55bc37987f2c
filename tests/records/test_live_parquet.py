"""New versions of a Parquet file, read with the footers of old ones."""

import io
from functools import partial
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qnerf import records
from qnerf.records import live_parquet
from qnerf.records.live_parquet import appended, encode, rewritten
from tests.helpers import processes
from tests.helpers.replacing import STEPS

SCHEMA = pa.schema([("step", pa.int64()), ("key", pa.string()), ("value", pa.float64())])
sizes = st.lists(st.integers(0, 40), min_size=1, max_size=6)


def table(rows: int, start: int = 0) -> pa.Table:
    steps = range(start, start + rows)
    columns = [list(steps), [f"key {step % 5}" for step in steps], [1 / (step + 1) for step in steps]]
    return pa.table([pa.array(column, field.type) for column, field in zip(columns, SCHEMA, strict=True)], SCHEMA)


def first() -> bytes:
    sink = io.BytesIO()
    pq.write_table(SCHEMA.empty_table(), sink)
    return sink.getvalue()


def read(data: bytes) -> pa.Table:
    return pq.ParquetFile(pa.BufferReader(data)).read(use_threads=False)


def read_late(footer_of: bytes, data: bytes) -> pa.Table:
    """Like a reader that has the footer of one version and then opens the file again and finds another version."""
    metadata = pq.read_metadata(pa.BufferReader(footer_of))
    return pq.ParquetFile(pa.BufferReader(data), metadata=metadata).read(use_threads=False)


@given(sizes)
def test_what_is_appended_follows_and_all_earlier_versions_stay_readable(rows: list[int]) -> None:
    versions, expected = [first()], [table(0)]
    for count in rows:
        versions.append(appended(versions[-1], table(count, expected[-1].num_rows)))
        expected.append(table(expected[-1].num_rows + count))
        for before, content in zip(versions, expected, strict=True):
            assert read_late(before, versions[-1]).equals(content)


@given(sizes, st.sampled_from([0, 2000, live_parquet.MAX_OLD_BYTES]))
def test_what_is_rewritten_leaves_the_version_before_readable(rows: list[int], most: int) -> None:
    data, content = first(), table(0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(live_parquet, "MAX_OLD_BYTES", most)
        for start, count in enumerate(rows):
            after = rewritten(data, partial(encode, table(count, 100 * start)))
            assert read_late(data, after).equals(content)
            data, content = after, table(count, 100 * start)
            assert read(data).equals(content)


def test_a_small_file_keeps_all_its_versions() -> None:
    versions = [first()]
    for start in range(20):
        versions.append(rewritten(versions[-1], partial(encode, table(5, start))))
    for start, version in enumerate(versions[1:]):
        assert read_late(version, versions[-1]).equals(table(5, start))


def test_a_file_that_is_rewritten_for_ever_does_not_grow_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_parquet, "MAX_OLD_BYTES", 0)
    data, lengths = first(), []
    for start in range(50):
        data = rewritten(data, partial(encode, table(40, start)))
        lengths.append(len(data))
    alone = len(encode(table(40)))
    assert max(lengths) < 4 * alone


def test_a_damaged_file_is_replaced_and_its_footer_ends_no_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """pyarrow ends the process when it is asked for a column whose part of the footer is damaged."""
    monkeypatch.setattr(live_parquet, "MAX_OLD_BYTES", 0)
    old = appended(encode(table(20)), table(20, 20))
    start, expected = live_parquet.footer_start(old), table(3)
    for place in range(start, len(old) - 8, 7):
        for bit in (1, 4, 64):
            damaged = bytearray(old)
            damaged[place] ^= bit
            assert read(rewritten(bytes(damaged), partial(encode, expected))).equals(expected)


def test_rows_follow_those_that_another_program_wrote() -> None:
    other = table(5).set_column(0, "step", pa.array(range(5), pa.int32()))
    sink = io.BytesIO()
    pq.write_table(other, sink)
    assert read(appended(sink.getvalue(), table(5, 5))).equals(table(10))


@pytest.mark.parametrize("reader", ["pandas", "duckdb"])
def test_readers_that_open_a_file_twice(tmp_path: Path, reader: str) -> None:
    """They read a part while another process replaces it."""
    duckdb = pytest.importorskip("duckdb") if reader == "duckdb" else None
    process = processes.start("replacing", str(tmp_path))
    part = tmp_path / "a" / "metrics" / "part-00000.parquet"
    reads = 0
    try:
        while process.poll() is None:
            if part.exists():
                rows = pd.read_parquet(part) if duckdb is None else duckdb.sql(f"select * from '{part}'").df()
                assert len(rows) == 10 * rows["step"].nunique()
                reads += 1
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0
    assert reads > 5
    assert len(records.read_metrics(tmp_path / "a")) == 10 * STEPS
