"""Ids of runs: a readable slug and a hash of everything that decides the numbers."""

import hashlib
import json
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import PurePath, PurePosixPath
from typing import Any

import numpy as np

from qnerf.config.compatibility import leaves_of, old_form, upgrade_config

EXECUTION = ("device", "store", "run", "threads", "hydra", "needs", "numerics.finite_checks")
"""Options and groups that say where and how a run is executed, not what it computes. `needs` is among them because the
id hashes the word `auto`, not its resolved value."""
SLUG_LENGTH = 80
DIGITS = 10  # hexadecimal


def plain(value: Any, name: str = "config") -> Any:
    """`value` as dicts with text keys, lists, text, numbers, booleans and None; ValueError for any other type."""
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

    Options in `EXECUTION` are left out. A `fingerprint` of the scene's contents replaces `scene.path`. 1 and 1.0 give
    the same id, and so does any order of keys. The id survives renamed options, and added ones that change nothing
    (`compatibility`).

    >>> identity({"seed": 1, "device": "cpu"}) == identity({"device": "cuda", "seed": 1.0})
    True
    """
    hashed = old_form(_computed(upgrade_config(plain(config))))
    if fingerprint is not None:
        scene = hashed.get("scene")
        hashed["scene"] = (dict(scene) if isinstance(scene, dict) else {"name": scene}) | {"path": fingerprint}
    text = json.dumps(_canonical(hashed), sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()[:DIGITS]


def run_id(slug: str, config: Mapping[str, Any], fingerprint: str | None = None) -> str:
    """The cleaned `slug`, a dash and `identity(config, fingerprint)`."""
    return f"{clean(slug)}-{identity(config, fingerprint)}"


def clean(slug: str) -> str:
    """Letters, digits, dot, underscore and dash only, at most `SLUG_LENGTH`, starting with a letter or digit.

    >>> clean("my scene/α=1")
    'my-scene-1'
    """
    text = re.sub(r"[^A-Za-z0-9._-]+", "-", slug)
    return text.lstrip("._-")[:SLUG_LENGTH].rstrip("._-") or "run"


def picture_names(images: Sequence[str]) -> list[str]:
    """A file name for the picture of each held-out image. Equal names get the image's number.

    >>> picture_names(["a/1.png", "b.png", "b.jpg"])
    ['a-1', 'b.1', 'b.2']
    """
    names = [clean(PurePosixPath(image).with_suffix("").as_posix()) for image in images]
    counts = Counter(names)
    used = set(names)
    for number, name in enumerate(names):
        while counts[name] > 1 and names[number] in used:  # an image's own name may end in a number, too
            names[number] += f".{number}"
        used.add(names[number])
    return names


def flatten(config: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted names -> values. Lists and empty dicts become JSON text, so that every value fits one table cell.

    >>> flatten({"train": {"steps": 10}, "samples": [1, 2]})
    {'train.steps': 10, 'samples': '[1, 2]'}
    """
    return {
        ".".join(path): json.dumps(value) if isinstance(value, (dict, list)) else value
        for path, value in leaves_of(plain(config)).items()
    }


def is_execution(name: str) -> bool:
    """Whether the dotted option says how a run is executed."""
    return any(f"{name}.".startswith(f"{key}.") for key in EXECUTION)


def _computed(config: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """`config` without the options in `EXECUTION`."""
    return {
        key: _computed(value, f"{prefix}{key}.") if isinstance(value, dict) else value
        for key, value in config.items()
        if not is_execution(f"{prefix}{key}")
    }


def _canonical(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _canonical(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_canonical(item) for item in value]
    if isinstance(value, float) and math.isfinite(value) and value.is_integer():
        return int(value)
    return value
