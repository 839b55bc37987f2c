"""The columns of a run's tables, how plain values become Arrow tables, and which values a reader accepts."""

import json
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import pyarrow as pa

from qnerf.config.compatibility import today
from qnerf.config.identity import flatten, plain
from qnerf.metrics import METRICS
from qnerf.records.owner import MAX_TIME, unix_time
from qnerf.records.parquet import KIND_OF_TYPE, KINDS, NAMES, fits

METRICS_SCHEMA = pa.schema(
    [("step", pa.int64()), ("time_s", pa.float64()), ("key", pa.string()), ("value", pa.float64())],
)
METRICS_KINDS = {"step": "int", "time_s": "float", "key": "text", "value": "float"}
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

_HEAD_NUMBERS = ("mlp.layers", "mlp.width", "qiren.layers", "qiren.spectral", "qiren.qubits")
_LABELS = ("field", "encoder", "qiren", "hash", "density", "color", "head", "sampler", "cameras", "train")
_KNOWN_KINDS = {
    **{name: "float" for name, metric in METRICS.items() if metric.kind},
    **dict.fromkeys(("seed", "train.steps"), "int"),
    **dict.fromkeys((f"{head}.{name}" for head in ("density", "color") for name in _HEAD_NUMBERS), "float"),
    **dict.fromkeys(
        (*_LABELS, "scene", "scene.name", "scene.path", "scene.fingerprint", "scene_name", "machine"), "text"
    ),
    **{name: KIND_OF_TYPE[str(kind)] for name, kind in SUMMARY_COLUMNS.items()},
}
_KNOWN_PREFIXES = ("params.", "time.")  # of numbers

TABLES = {
    "eval": {"image": "text", "step": "int"},
    "eval_hardware": {"image": "text", "shots": "int", "noise": "text", "p": "float", "psnr": "float"},
    "units": {"when": "text", "head": "text", "kind": "text", "units": "int", "dead": "float", "std": "float"},
    "rays": {
        **dict.fromkeys(("image", "strategy", "level"), "text"),
        **dict.fromkeys(("pixel_x", "pixel_y"), "int"),
        **dict.fromkeys(("start", "end", "weight", "transmittance", "depth"), "float"),
        "own": "bool",
    },
    "encoding": {
        "encoder": "text",
        "trained": "bool",
        "row": "int",
        "column": "int",
        **{f"channel_{number}": "float" for number in range(8)},
    },
    "cost": {
        "head": "text",
        **dict.fromkeys(
            ("circuit", "wires", "one_qubit_gates", "two_qubit_gates", "depth", "view", "step"),
            "int",
        ),
        **dict.fromkeys(("view_hours", "step_hours"), "float"),
    },
    **{
        name: {"head": "text", "circuit": "int", **columns}
        for name, columns in {
            "expressibility": {"weights": "text", "expressibility": "float", "haar": "float", "pairs": "int"},
            "entangling": {"weights": "text", "entanglement": "float", "standard_error": "float", "haar": "float"},
            "fisher": {
                **dict.fromkeys(("index", "parameters", "rank"), "int"),
                **dict.fromkeys(("eigenvalue", "effective_dimension", "local_effective_dimension"), "float"),
            },
            "kernel": {"index": "int", "eigenvalue": "float", "effective_rank": "float"},
            "surrogate": {"waves": "int", "covered": "bool", "error": "float"},
        }.items()
    },
    "spectrum": {
        "head": "text",
        "method": "text",
        "circuit": "int",
        "wire": "int",
        "output": "int",
        **dict.fromkeys(("frequency", "power", "mean", "variance", "standard_error", "angle_std"), "float"),
    },
}
"""Table of a run, such as eval.parquet -> the columns that its readers need, and the kind of their values."""

_STATUS_KINDS = {"state": str, "error": str, "run_id": str, "step": int}
_STATUS_TIMES = ("created", "heartbeat")


@lru_cache(maxsize=4096)
def summary_kinds(names: tuple[str, ...], types: tuple[str, ...]) -> tuple[str, ...]:
    """Kinds of a summary's columns from the names of their Arrow types; text for types that no run writes.

    Raises:
        ValueError: a name is no text, or a column that tables and figures compute with has values of another kind.
    """
    if not all(isinstance(name, str) for name in names):
        raise ValueError("names of columns must be text")
    kinds = tuple(KIND_OF_TYPE.get(kind, "text") for kind in types)
    for name, kind, actual in zip(names, kinds, types, strict=True):
        expected = known_kind(today(name))
        if expected is not None and not fits(kind, expected):
            raise ValueError(f"{name}: expected {NAMES[expected]}, got {actual}")
    return kinds


def known_kind(name: str) -> str | None:
    """The kind of a summary's column that tables and figures compute with; None for any other column."""
    return "float" if name.startswith(_KNOWN_PREFIXES) else _KNOWN_KINDS.get(name)


def plain_row(names: Sequence[str], types: Sequence[str], values: Sequence[Any]) -> dict[str, Any]:
    """The row of a summary under today's names; ValueError as `summary_kinds`, or for a value of another type."""
    row = {}
    for name, kind, value in zip(names, summary_kinds(tuple(names), tuple(types)), values, strict=True):
        try:
            (row[today(name)],) = pa.array([value], KINDS[kind]).to_pylist()
        except (pa.ArrowException, TypeError, OverflowError, UnicodeError) as error:
            raise ValueError(f"{name}: expected {NAMES.get(kind, 'no value')}, got {value!r:.60}") from error
    return row


def check_status(record: Mapping[str, Any]) -> None:
    """ValueError unless the values of a status.json that readers use have their types; absent ones may be missing."""
    for name, kind in _STATUS_KINDS.items():
        value = record.get(name)
        if value is not None and (not isinstance(value, kind) or isinstance(value, bool)):
            raise ValueError(f"{name}: expected {kind.__name__}, got {value!r:.60}")
    if not 0 <= (record.get("step") or 0) < 2**63:
        raise ValueError(f"step: expected a whole number of at least 0 within 64 bits, got {record['step']!r:.60}")
    for name in _STATUS_TIMES:
        if record.get(name) is not None and unix_time(record[name]) is None:
            raise ValueError(f"{name}: expected a Unix time from 0 to {MAX_TIME:.0f}, got {record[name]!r:.60}")


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
    Arrow's null type, which can be joined with any other. A number that was left to `auto` is what was decided.
    """
    columns: dict[str, pa.Array] = {}
    for name, value in {**dict.fromkeys(SUMMARY_COLUMNS), **plain(results, "summary")}.items():
        if isinstance(value, (dict, list)):
            value = json.dumps(value)
        columns[name] = _array(name, [value], SUMMARY_COLUMNS.get(name) or _result_type(name, value))
    for name, value in flatten({key: value for key, value in config.items() if key != "hydra"}).items():
        columns.setdefault(name, pa.array([_decided(config, name, value)]))
    return pa.table(columns)


def _decided(config: Mapping[str, Any], name: str, value: Any) -> Any:
    """The value of an option; in place of `auto`, the number for it if tables and figures compute with it."""
    decision = (config.get("needs") or {}).get(name)
    if isinstance(decision, Mapping) and not isinstance(value, int) and known_kind(name) == "int":
        return decision["value"]
    return value


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
