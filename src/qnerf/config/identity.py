"""Ids of runs: a readable slug and a hash of everything that decides the numbers."""

import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import PurePath, PurePosixPath
from typing import Any

import numpy as np

from qnerf.config.compatibility import old_form, upgrade_config

EXECUTION = ("device", "store", "run", "threads", "hydra", "needs", "numerics.finite_checks")
"""Options and groups that say where and how a run is executed, not what it computes. `needs` holds what `auto` was
resolved to: the id hashes the word `auto`."""
SLUG_LENGTH = 80
DIGITS = 10  # hexadecimal


def plain(value: Any, name: str = "config") -> Any:
    """`value` as dicts with text keys, lists, text, numbers, booleans and None; ValueError names the rest."""
    if isinstance(value, Mapping):
        return {str(key): plain(item, f"{name}.{key}") for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item, f"{name}[{i}]") for i, item in enumerate(value)]
    if isinstance(value, np.generic):
        return plain(value.item(), name)
    if isinstance(value, PurePath):
        return str(value)
    if value is None or type(value) in (bool, int, float, str):
        return value
    for kind in (str, int, float):  # subclasses, such as enumerations of text
        if isinstance(value, kind):
            return kind(value)
    raise ValueError(f"{name}: expected text, number, true/false, null, list or dict, got {type(value).__name__}")


def identity(config: Mapping[str, Any], fingerprint: str | None = None) -> str:
    """Ten hexadecimal digits of the SHA-256 of the resolved configuration.

    `EXECUTION` is left out; with a `fingerprint` of the scene's contents, it stands for `scene.path`. Equal numbers
    count as equal however they were written (1 and 1.0); the order of keys does not matter. Neither a new name nor an
    option that was added later and changes nothing makes another id (`compatibility`).
    """
    hashed = old_form(_computed(upgrade_config(plain(config))))
    if fingerprint is not None:
        scene = hashed.get("scene")
        hashed["scene"] = (dict(scene) if isinstance(scene, dict) else {"name": scene}) | {"path": fingerprint}
    text = json.dumps(_canonical(hashed), sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()[:DIGITS]


def run_id(slug: str, config: Mapping[str, Any], fingerprint: str | None = None) -> str:
    """`slug`, made fit for a folder's name, a dash and `identity(config, fingerprint)`."""
    return f"{clean(slug)}-{identity(config, fingerprint)}"


def clean(slug: str) -> str:
    """Letters, digits, dot, underscore and dash only, at most `SLUG_LENGTH`, starting with a letter or digit."""
    text = re.sub(r"[^A-Za-z0-9._-]+", "-", slug)
    return text.lstrip("._-")[:SLUG_LENGTH].rstrip("._-") or "run"


def picture_names(images: Sequence[str]) -> list[str]:
    """Names of the pictures of held-out images, all different: `clean`, with its number where several were the same."""
    names = [clean(PurePosixPath(image).with_suffix("").as_posix()) for image in images]
    return [name if names.count(name) == 1 else f"{name}.{number}" for number, name in enumerate(names)]


def flatten(config: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted names -> values. Lists and empty dicts become JSON text, so that every value fits one table cell."""
    flat: dict[str, Any] = {}

    def visit(prefix: str, value: Any) -> None:
        if isinstance(value, dict) and value:
            for key, item in value.items():
                visit(f"{prefix}.{key}" if prefix else key, item)
        elif isinstance(value, (dict, list)):
            flat[prefix] = json.dumps(value)
        else:
            flat[prefix] = value

    for key, value in plain(config).items():
        visit(key, value)
    return flat


def is_execution(name: str) -> bool:
    """Whether the dotted name of a key says how a run is executed."""
    return any(f"{name}.".startswith(f"{key}.") for key in EXECUTION)


def _computed(config: dict[str, Any], above: str = "") -> dict[str, Any]:
    """`config` without what is execution."""
    return {
        key: _computed(value, f"{above}{key}.") if isinstance(value, dict) else value
        for key, value in config.items()
        if not is_execution(f"{above}{key}")
    }


def _canonical(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _canonical(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_canonical(item) for item in value]
    if isinstance(value, float) and math.isfinite(value) and value.is_integer():
        return int(value)
    return value
