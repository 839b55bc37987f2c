"""Which values a JSON or YAML file of a run may hold."""

from typing import Any

MAX_DEPTH = 32
_PLAIN = (str, int, float, bool, type(None))


def check_plain(value: Any, depth: int = 0) -> None:
    """ValueError unless the value is text, a number, true, false, null, or a list or object of these with text as keys.

    Lists and objects may be nested to `MAX_DEPTH`, so that recursive functions can walk through them.

    >>> check_plain({"train": {"steps": [1, 2]}})
    >>> check_plain({"train": {None: 1}})
    Traceback (most recent call last):
        ...
    ValueError: keys must be text, got None
    """
    if isinstance(value, (dict, list)):
        if depth == MAX_DEPTH:
            raise ValueError(f"nested more than {MAX_DEPTH} deep")
        for key in value if isinstance(value, dict) else ():
            if not isinstance(key, str):
                raise ValueError(f"keys must be text, got {key!r:.60}")
        for item in value.values() if isinstance(value, dict) else value:
            check_plain(item, depth + 1)
    elif type(value) not in _PLAIN:
        raise ValueError(f"expected text, a number, true, false or null, got {type(value).__name__}")
