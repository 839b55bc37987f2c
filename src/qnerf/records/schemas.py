"""Columns of the three tables and how plain values become Parquet."""

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from qnerf.config.identity import flatten, plain
from qnerf.records.summary_row import encode as encode_row

METRICS = pa.schema(
    [("step", pa.int64()), ("time_s", pa.float64()), ("key", pa.string()), ("value", pa.float64())],
)
EVAL = {
    "image": pa.string(),
    "step": pa.int64(),
    "psnr": pa.float64(),
    "ssim": pa.float64(),
    "lpips": pa.float64(),
    "lpips_reason": pa.string(),
    "depth_error": pa.float64(),
}
SUMMARY = {
    "run_id": pa.string(),
    "state": pa.string(),
    "error": pa.string(),
    "params.encoder": pa.int64(),
    "params.density": pa.int64(),
    "params.color": pa.int64(),
    "psnr": pa.float64(),
    "ssim": pa.float64(),
    "lpips": pa.float64(),
    "lpips_reason": pa.string(),
    "depth_error": pa.float64(),
    "train_s": pa.float64(),
    "step_ms": pa.float64(),
    "steps": pa.int64(),
}


def encode(table: pa.Table, dictionary: Sequence[str] = ()) -> bytes:
    """Parquet bytes; a single row is written so that it is had from the footer alone."""
    if table.num_rows == 1:
        return encode_row(table)
    sink = pa.BufferOutputStream()
    pq.write_table(
        table, sink, compression="zstd", compression_level=1, use_dictionary=list(dictionary), store_schema=False
    )
    return sink.getvalue().to_pybytes()


def evaluation(rows: Iterable[Mapping[str, Any]], step: int) -> pa.Table:
    """One row an image. Columns of `EVAL` are always there; others are text, or float64 where no value is text."""
    rows = [{"step": step, **plain(row, "eval")} for row in rows]
    names = dict.fromkeys([*EVAL, *(name for row in rows for name in row)])
    columns = {}
    for name in names:
        values = [row.get(name) for row in rows]
        kind = EVAL.get(name) or (pa.string() if any(isinstance(v, str) for v in values) else pa.float64())
        columns[name] = _array(name, values, kind)
    return pa.table(columns)


def summary(results: Mapping[str, Any], config: Mapping[str, Any]) -> pa.Table:
    """One row: `results`, then the flat configuration (a result wins over a key of the same name).

    Columns of `SUMMARY` are always there and have their types. Of the other results `params.*` are int64, text is text,
    true/false stays that, and everything else, absent values too, is float64. Configuration values keep their own type;
    an absent one has Arrow's null type, which joins any other.
    """
    columns: dict[str, pa.Array] = {}
    for name, value in {**dict.fromkeys(SUMMARY), **plain(results, "summary")}.items():
        if isinstance(value, (dict, list)):
            value = json.dumps(value)
        columns[name] = _array(name, [value], SUMMARY.get(name) or _result_type(name, value))
    for name, value in flatten({key: value for key, value in config.items() if key != "hydra"}).items():
        columns.setdefault(name, pa.array([value]))
    return pa.table(columns)


def _result_type(name: str, value: Any) -> pa.DataType:
    if isinstance(value, bool):
        return pa.bool_()
    if isinstance(value, str):
        return pa.string()
    return pa.int64() if name.startswith("params.") else pa.float64()


def _array(name: str, values: list[Any], kind: pa.DataType) -> pa.Array:
    number = pa.types.is_integer(kind) or pa.types.is_floating(kind)
    for value in values:
        fits = value is None or (isinstance(value, (int, float)) if number else True)
        if not fits:
            raise ValueError(f"{name}: expected a number, got {value!r}")
    if pa.types.is_string(kind):
        texts = [value if value is None or isinstance(value, str) else json.dumps(value) for value in values]
        # What is no Unicode, such as a file's name in another encoding, is shown with question marks.
        values = [text if text is None else text.encode(errors="replace").decode() for text in texts]
    elif pa.types.is_integer(kind):
        values = [None if value is None else int(value) for value in values]
    elif pa.types.is_floating(kind):
        values = [None if value is None else float(value) for value in values]
    return pa.array(values, kind)
