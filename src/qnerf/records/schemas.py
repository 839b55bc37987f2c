"""The columns of the three tables of a run, and how plain values become Arrow tables."""

import json
from collections.abc import Iterable, Mapping
from typing import Any

import pyarrow as pa

from qnerf.config.identity import flatten, plain

METRICS_SCHEMA = pa.schema(
    [("step", pa.int64()), ("time_s", pa.float64()), ("key", pa.string()), ("value", pa.float64())],
)
_QUALITY = {
    "psnr": pa.float64(),
    "ssim": pa.float64(),
    "lpips": pa.float64(),
    "lpips_reason": pa.string(),
    "depth_error": pa.float64(),
}
EVAL_COLUMNS = {"image": pa.string(), "step": pa.int64(), **_QUALITY}
SUMMARY_COLUMNS = {
    "run_id": pa.string(),
    "state": pa.string(),
    "error": pa.string(),
    "params.encoder": pa.int64(),
    "params.density": pa.int64(),
    "params.color": pa.int64(),
    **_QUALITY,
    "train_s": pa.float64(),
    "step_ms": pa.float64(),
    "steps": pa.int64(),
}


def evaluation(rows: Iterable[Mapping[str, Any]], step: int) -> pa.Table:
    """One row per image. The columns of `EVAL_COLUMNS` always exist; others are float64, or text if a value is text."""
    rows = [{"step": step, **plain(row, "eval")} for row in rows]
    names = dict.fromkeys([*EVAL_COLUMNS, *(name for row in rows for name in row)])
    columns = {}
    for name in names:
        values = [row.get(name) for row in rows]
        kind = EVAL_COLUMNS.get(name) or (pa.string() if any(isinstance(v, str) for v in values) else pa.float64())
        columns[name] = _array(name, values, kind)
    return pa.table(columns)


def summary(results: Mapping[str, Any], config: Mapping[str, Any]) -> pa.Table:
    """One row: `results`, then the flat configuration. A result wins over an option of the same name.

    The columns of `SUMMARY_COLUMNS` always exist, with their types. Other results: `params.*` are int64, text and
    booleans stay, everything else is float64, also absent values. Options keep their own type; an absent option has
    Arrow's null type, which can be joined with any other.
    """
    columns: dict[str, pa.Array] = {}
    for name, value in {**dict.fromkeys(SUMMARY_COLUMNS), **plain(results, "summary")}.items():
        if isinstance(value, (dict, list)):
            value = json.dumps(value)
        columns[name] = _array(name, [value], SUMMARY_COLUMNS.get(name) or _result_type(name, value))
    for name, value in flatten({key: value for key, value in config.items() if key != "hydra"}).items():
        columns.setdefault(name, pa.array([value]))
    return pa.table(columns)


def results(summary: Mapping[str, Any], config: Mapping[str, Any]) -> dict[str, Any]:
    """The columns of a summary that are results: all that are not options of the configuration."""
    options = flatten(config)
    return {name: value for name, value in summary.items() if name in SUMMARY_COLUMNS or name not in options}


def _result_type(name: str, value: Any) -> pa.DataType:
    if isinstance(value, bool):
        return pa.bool_()
    if isinstance(value, str):
        return pa.string()
    return pa.int64() if name.startswith("params.") else pa.float64()


def _array(name: str, values: list[Any], kind: pa.DataType) -> pa.Array:
    if pa.types.is_string(kind):
        texts = [value if value is None or isinstance(value, str) else json.dumps(value) for value in values]
        # What is not Unicode, such as a file name in another encoding, gets question marks.
        return pa.array([text if text is None else text.encode(errors="replace").decode() for text in texts], kind)
    number = int if pa.types.is_integer(kind) else float if pa.types.is_floating(kind) else None
    if number is None:
        return pa.array(values, kind)
    for value in values:
        if value is not None and not isinstance(value, (int, float)):
            raise ValueError(f"{name}: expected a number, got {value!r}")
    return pa.array([None if value is None else number(value) for value in values], kind)
