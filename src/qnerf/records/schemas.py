"""The columns of a run's tables.

A column's type is declared, here or by the run's options. So the tables of all runs can be read as one.
"""

import json
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Any

import pyarrow as pa

from qnerf.config.identity import flatten, plain
from qnerf.metrics import METRICS
from qnerf.records.parquet import TYPES

METRICS_KINDS = {"step": "int", "time_s": "float", "key": "text", "value": "float"}
METRICS_SCHEMA = pa.schema([(name, TYPES[kind]) for name, kind in METRICS_KINDS.items()])

_QUALITY = ("psnr", "ssim", "lpips", "lpips_reason", "depth_error")
_EVAL_COLUMNS = ("image", "step", *_QUALITY)
_SUMMARY_COLUMNS = (
    "run_id", "state", "error", "params.encoder", "params.density", "params.color", *_QUALITY, "train_s", "step_ms",
    "steps",
)  # fmt: skip
"""Columns that every such table has."""

_RESULTS = {
    **dict.fromkeys(("run_id", "state", "error", "stopped", "machine", "scene.fingerprint", "image"), "text"),
    **dict.fromkeys(("step", "steps", "eval_views"), "int"),
}
_PREFIXES = {"params.": "int", "time.": "float"}
RESULT_GROUPS = ("params", "time", "cost")
"""First parts of the dotted names of results; a dotted name that begins otherwise is an option."""
LABELS = ("field", "encoder", "qiren", "hash", "density", "color", "head", "sampler", "cameras", "train")
"""Columns that name a run's choices; a label that does not act in a run is absent."""
RECORDED = ("scene.path", "train.name", "train.eval_every", "train.eval_views", "train.log_every")
"""Options that a run keeps but its id does not hash: the scene's place, the recipe's name, and what is measured how
often."""
RUN_COLUMNS = ("run_id", "state", "error", "path", "step", "created", "heartbeat")
"""Columns of the table of all runs that do not come from the summary, even if it has values with these names."""
_HEAD_NUMBERS = ("mlp.layers", "mlp.width", "qiren.layers", "qiren.spectral", "qiren.qubits")
NUMBERS = ("seed", "train.steps", *(f"{head}.{name}" for head in ("density", "color") for name in _HEAD_NUMBERS))
"""Options that tables and figures compute with."""

TABLES = {
    "eval": {"image": "text", "step": "int"},
    "eval_hardware": {"image": "text", "shots": "int", "noise": "text", "p": "float", "psnr": "float"},
    "units": {"when": "text", "head": "text", "kind": "text", "units": "int", "dead": "float", "std": "float"},
}
"""Table of a run, such as eval.parquet -> the columns that its readers need, and the kind of their values."""


PROBES = (
    "eval_hardware", "spectrum", "units", "cost", "expressibility", "entangling", "fisher",
    "kernel", "surrogate",
)  # fmt: skip
"""Tables that `qnerf probe` leaves in a run's folder."""


def result_kind(name: str) -> str | None:
    """The declared kind of a result; None: text and booleans keep theirs, any other number is a float."""
    if name in METRICS:
        return "int" if METRICS[name].kind == "size" else "float"
    if name.endswith("_reason"):
        return "text"
    return _RESULTS.get(name) or next((kind for start, kind in _PREFIXES.items() if name.startswith(start)), None)


@lru_cache(maxsize=4096)
def known_kind(name: str) -> str | None:
    """The kind of a summary's column that tables and figures compute with; None for any other column."""
    return "int" if name in NUMBERS else result_kind(name)


def is_own(name: str) -> bool:
    """Whether a result is one that only a tracked run has: nobody declared it, or it is a loss."""
    return known_kind(name) is None or (name in METRICS and METRICS[name].kind == "loss")


def check_result(name: str, config: Mapping[str, Any]) -> None:
    """ValueError if a result has the name of an option of the run, or of a column that says which run it is."""
    group, dot, _ = name.partition(".")
    if name in ("seed", "scene", "scene_name", *LABELS, *RUN_COLUMNS) or name in flatten(config):
        raise ValueError(
            f"{name}: is the name of an option or of the run's own column; expected another for the result"
        )
    if dot and group not in RESULT_GROUPS:
        raise ValueError(f"{name}: dots are for options; expected a result such as {name.replace('.', '/')}")


def is_option(name: str) -> bool:
    """Whether a column with a dotted name is an option of a run, not a result."""
    return "." in name and " @ " not in name and name.partition(".")[0] not in RESULT_GROUPS


def evaluation(rows: Iterable[Mapping[str, Any]], step: int) -> pa.Table:
    """One row per image. The columns of `_EVAL_COLUMNS` always exist; others are float64, or text for `*_reason`."""
    rows = [{"step": step, **plain(row, "eval")} for row in rows]
    names = dict.fromkeys([*_EVAL_COLUMNS, *(name for row in rows for name in row)])
    values = {name: [row.get(name) for row in rows] for name in names}
    return pa.table({name: _array(name, own, result_kind(name) or "float") for name, own in values.items()})


def summary(results: Mapping[str, Any], config: Mapping[str, Any], kinds: Mapping[str, str]) -> pa.Table:
    """One row: `results`, then the flat configuration. A result wins over an option of the same name.

    kinds: dotted option -> int, float, bool or text. What is not declared is float64, bool or text, and has no column
    if it is None.
    """
    columns: dict[str, pa.Array | None] = {}
    for name, value in {**dict.fromkeys(_SUMMARY_COLUMNS), **plain(results, "summary")}.items():
        columns[name] = _array(name, [value], result_kind(name))
    for name, value in flatten({key: value for key, value in config.items() if key != "hydra"}).items():
        if columns.get(name) is None:
            columns[name] = _array(name, [value], kinds.get(name))
    return pa.table({name: column for name, column in columns.items() if column is not None})


def results(summary: Mapping[str, Any], config: Mapping[str, Any]) -> dict[str, Any]:
    """The columns of a summary that are results: all that are not options of the configuration."""
    options = flatten(config)
    return {name: value for name, value in summary.items() if name in _SUMMARY_COLUMNS or name not in options}


def _array(name: str, values: list[Any], kind: str | None) -> pa.Array | None:
    """A column of this kind; without a kind of the kind of its values, and no column if it has no value."""
    filled = [value for value in values if value is not None]
    if kind is None:
        if not filled:
            return None
        kind = "bool" if isinstance(filled[0], bool) else "float" if isinstance(filled[0], (int, float)) else "text"
    if kind == "text":
        texts = [value if isinstance(value, str) else json.dumps(value) for value in filled]
        # What is not Unicode, such as a file name in another encoding, gets question marks.
        encodable = iter([text.encode(errors="replace").decode() for text in texts])
        return pa.array([None if value is None else next(encodable) for value in values], TYPES[kind])
    allowed = (bool,) if kind == "bool" else (int, float)
    expected = {"int": "a whole number", "float": "a number", "bool": "true or false"}[kind]
    for value in filled:
        broken = kind == "int" and isinstance(value, float) and not value.is_integer()
        if broken or not isinstance(value, allowed) or (kind != "bool" and isinstance(value, bool)):
            raise ValueError(f"{name}: expected {expected}, got {value!r:.60}")
    number = {"int": int, "float": float, "bool": bool}[kind]
    return pa.array([None if value is None else number(value) for value in values], TYPES[kind])
