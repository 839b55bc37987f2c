"""Ids of runs: a readable slug, and a hash of what decides the numbers."""

import hashlib
import json
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import PurePath, PurePosixPath
from typing import Any

SLUG_LENGTH = 80
DIGITS = 10  # hexadecimal


def plain(value: Any, name: str = "config") -> Any:
    """`value` as dicts with text keys, lists, text, numbers, booleans and None.

    ValueError for any other type, and for a key that is neither text nor a number, or equals another one as text.
    """
    if isinstance(value, Mapping):
        texts = dict.fromkeys(map(str, value))
        for key in value:
            if not isinstance(key, (str, int, float)) or not is_unicode(str(key)) or len(texts) < len(value):
                raise ValueError(f"{name}: expected keys of text, each once, got {key!r:.100}")
        return {str(key): plain(item, f"{name}.{key}") for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item, f"{name}[{i}]") for i, item in enumerate(value)]
    if getattr(value, "shape", None) == ():  # of NumPy or PyTorch
        return plain(value.item(), name)
    if isinstance(value, PurePath):
        return str(value)
    if value is None or type(value) in (bool, int, float, str):
        return value
    for kind in (str, int, float):  # subclasses, such as enumerations of text
        if isinstance(value, kind):
            return kind(value)
    raise ValueError(f"{name}: expected text, number, true/false, null, list or dict, got {type(value).__name__}")


def is_unicode(text: str) -> bool:
    """Whether UTF-8 can say it: names of files and arguments in another encoding have characters that it lacks."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def digest(decisive: Mapping[str, Any], fingerprint: str) -> str:
    """Ten hexadecimal digits of the SHA-256 of the options that decide a run's numbers, and of its scene's contents.

    1 and 1.0 give the same digits, and so does any order of keys. Floats are hashed by nine digits, because measured
    ones differ in the last bits between processors.

    >>> digest({"seed": 1}, "a") == digest({"seed": 1.0}, "a")
    True
    """
    text = json.dumps([_canonical(plain(decisive)), fingerprint], sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:DIGITS]


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
        name: json.dumps(value) if isinstance(value, (dict, list)) else value for name, value in leaves(plain(config))
    }


def leaves(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted name and value of every option that is not a group."""
    for key, value in config.items():
        if isinstance(value, Mapping) and value:
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _canonical(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _canonical(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_canonical(item) for item in value]
    if isinstance(value, float) and math.isfinite(value):
        return int(value) if value.is_integer() else float(f"{value:.9g}")
    return value
