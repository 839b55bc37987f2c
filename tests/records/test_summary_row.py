"""The row in the footer of a summary is always the row of its columns."""

import json

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qnerf.records import schemas, summary_row

values = st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats() | st.text()
rows = st.dictionaries(st.text(min_size=1), values, min_size=1)


def columns(data: bytes) -> pa.Table:
    return pq.ParquetFile(pa.BufferReader(data)).read(use_threads=False)


def summary(**results: object) -> bytes:
    return summary_row.encode(
        schemas.summary({"run_id": "a", "psnr": 21.5} | results, {"seed": 3, "train": {"lr": 0.01}})
    )


@given(rows)
def test_the_footer_repeats_the_columns(content: dict) -> None:
    table = pa.table({name: pa.array([value]) for name, value in content.items()})
    data = summary_row.encode(table)
    names, types, values_read = summary_row.decode(data)
    read = columns(data)
    assert names == read.schema.names
    assert types == [str(kind) for kind in read.schema.types]
    assert repr(values_read) == repr(list(read.to_pylist()[0].values()))  # repr, because nan differs from itself


def test_without_an_entry_the_columns_are_read() -> None:
    data = summary()
    sink = pa.BufferOutputStream()
    pq.write_table(columns(data).replace_schema_metadata(), sink)
    assert b"qnerf.row" not in sink.getvalue().to_pybytes()
    assert summary_row.decode(sink.getvalue().to_pybytes()) == summary_row.decode(data)


@pytest.mark.parametrize("change", ["value", "name", "type", "order"])
def test_an_entry_that_another_program_carried_over_does_not_count(change: str) -> None:
    before = summary()
    metadata = pq.read_metadata(pa.BufferReader(before)).metadata
    table = columns(before)
    column = table.schema.get_field_index("psnr")
    if change == "value":
        table = table.set_column(column, "psnr", pa.array([99.0]))
    elif change == "name":
        table = table.rename_columns(["quality" if name == "psnr" else name for name in table.schema.names])
    elif change == "type":
        table = table.set_column(column, "psnr", pa.array([21]))
    else:
        table = table.select(table.schema.names[::-1])
    sink = pa.BufferOutputStream()
    with pq.ParquetWriter(sink, table.schema, compression="none", use_dictionary=False, write_statistics=False) as file:
        file.write_table(table)
        file.add_key_value_metadata({"qnerf": metadata[b"qnerf"]})
    data = sink.getvalue().to_pybytes()
    assert b"qnerf.row" in data
    names, _, values_read = summary_row.decode(data)
    assert dict(zip(names, values_read, strict=True)) == table.to_pylist()[0]
    assert summary_row.decode(data) != summary_row.decode(before)


def test_a_bit_that_flips_is_noticed_by_the_entry() -> None:
    data = summary()
    entry = data.index(b'["qnerf.row"')
    for position in range(0, entry, 37):
        flipped = data[:position] + bytes([data[position] ^ 1]) + data[position + 1 :]
        try:
            values_read = summary_row.decode(flipped)
        except (ValueError, OSError):
            continue
        # the entry was not used: the columns were read
        assert repr(values_read[2]) == repr(list(columns(flipped).to_pylist()[0].values()))


def test_pandas_reads_it_like_any_other_file(tmp_path) -> None:
    (tmp_path / "summary.parquet").write_bytes(summary(note="ä"))
    read = pd.read_parquet(tmp_path / "summary.parquet")
    assert (len(read), read["psnr"][0], read["seed"][0], read["note"][0]) == (1, 21.5, 3, "ä")


@pytest.mark.parametrize("entry", ["[]", "{}", "[" * 5000, json.dumps(["qnerf.row", "00000000", [], [], []]), "x"])
def test_entries_that_are_none(entry: str) -> None:
    table = pa.table({"psnr": [1.0]})
    sink = pa.BufferOutputStream()
    with pq.ParquetWriter(sink, table.schema) as file:
        file.write_table(table)
        file.add_key_value_metadata({"qnerf": entry})
    assert summary_row.decode(sink.getvalue().to_pybytes()) == (["psnr"], ["double"], [1.0])


@pytest.mark.parametrize("data", [b"", b"PAR1", b"PAR1" + bytes(50) + b"PAR1", b"hello" * 100])
def test_what_is_no_parquet_file(data: bytes) -> None:
    with pytest.raises((ValueError, OSError)):
        summary_row.decode(data)


@pytest.mark.parametrize("length", [0, 2])
def test_there_must_be_one_row(length: int) -> None:
    sink = pa.BufferOutputStream()
    pq.write_table(pa.table({"psnr": [1.0] * length}), sink)
    with pytest.raises(ValueError, match=f"expected one row, got {length}"):
        summary_row.decode(sink.getvalue().to_pybytes())
