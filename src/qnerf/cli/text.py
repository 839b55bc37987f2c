"""How the commands print text, numbers, times and sizes."""

import json
import math
import numbers
import time
from typing import Any

from rich.console import Console
from rich.text import Text

from qnerf.cli.ends import escape_unencodable
from qnerf.metrics import Metric
from qnerf.records.printable import printable

STATE_STYLES = {"running": "cyan", "finished": "green", "interrupted": "yellow", "failed": "red", "damaged": "magenta"}


def console() -> Console:
    """Standard output."""
    escape_unencodable()
    return Console(highlight=False, markup=False, emoji=False)


def styled(value: object, style: str = "", limit: int | None = None) -> Text:
    """`printable(value)` in a style."""
    return Text(printable(value, limit), style)


def missing(value: Any) -> bool:
    """Whether there is no value: None or NaN."""
    return value is None or (isinstance(value, float) and math.isnan(value))


def _odd(value: Any) -> str | None:
    """Text for anything but a finite number: `-` for no value, else the value as it is."""
    if missing(value):
        return "-"
    return None if isinstance(value, numbers.Real) and math.isfinite(value) else str(value)


def as_json(value: Any) -> str:
    """JSON in ASCII, which is safe to print; NaN and infinities become null."""
    return json.dumps(_finite(value), indent=1, default=str)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def measured(value: Any, metric: Metric, unit: bool = False) -> str:
    """The value of a metric as `23.91`, with its unit if asked; `-` if there is no value."""
    return _odd(value) or (metric.with_unit(value) if unit else metric.text(value))


def count(value: Any) -> str:
    """`1,055,947`; `-` if there is no value."""
    return _odd(value) or f"{int(value):,}"


def duration(seconds: Any) -> str:
    """`4.2s`, `43s`, `1m53s`, `2h05m`, `3d04h`; `-` if there is no value.

    >>> duration(113), duration(7500), duration(None)
    ('1m53s', '2h05m', '-')
    """
    if odd := _odd(seconds):
        return odd
    if seconds < 9.95:
        return f"{max(seconds, 0):.1f}s"
    whole = round(seconds)
    for unit, small, size, small_size in (("d", "h", 86400, 3600), ("h", "m", 3600, 60), ("m", "s", 60, 1)):
        if whole >= size:
            return f"{whole // size}{unit}{whole % size // small_size:02}{small}"
    return f"{whole}s"


def age(moment: Any) -> str:
    """Time since a Unix time as `43s`, `12m`, `5h`, `3d`; `-` if there is no value."""
    if odd := _odd(moment):
        return odd
    seconds = max(time.time() - moment, 0)
    for unit, size in (("d", 86400), ("h", 3600), ("m", 60)):
        if seconds >= 2 * size:
            return f"{seconds // size:.0f}{unit}"
    return f"{seconds:.0f}s"
