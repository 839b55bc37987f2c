"""What a search looks for: numbers of a run's summary, each with its better direction."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from qnerf.config.checks import is_number
from qnerf.metrics import HEAD_PARAMETERS, METRICS, metric_of

Direction = Literal["maximize", "minimize"]
KNOWN = tuple(key for key, item in METRICS.items() if item.kind != "loss" and (item.better or item.kind == "size"))

TUNING = (271_828_180, 271_828_181, 271_828_182)
"""Seeds that judge nothing, of which tables leave runs out. `qnerf decide --tune` searches with the first one, and
trains its best trials again with the others; a search where training sees all points takes any of them."""


def check(objectives: Sequence[str]) -> None:
    """ValueError unless the objectives are numbers of which it is known which way is better."""
    if not objectives or len(set(objectives)) < len(objectives):
        raise ValueError(f"objectives must be one or more different metrics, got {list(objectives)}")
    for name in objectives:
        if name not in KNOWN:
            raise ValueError(f"unknown objective {name!r}; known: {', '.join(KNOWN)}")


def direction(objective: str) -> Direction:
    """Fewer parameters, less time and less memory are better; the metrics of images say themselves.

    >>> direction("psnr"), direction("params.total")
    ('maximize', 'minimize')
    """
    return "maximize" if metric_of(objective).better == "higher" else "minimize"


def columns(objectives: Sequence[str]) -> list[str]:
    """The columns of summary.parquet that the objectives are computed from."""
    return [
        name for objective in objectives for name in (HEAD_PARAMETERS if objective == "params.heads" else [objective])
    ]


def value(summary: Mapping[str, Any], objective: str) -> float | None:
    """The objective of a run; None if its summary has no number for it."""
    found = [float(number) for name in columns([objective]) if is_number(number := summary.get(name))]
    return sum(found) if found else None


def judged(objectives: Sequence[str]) -> str | None:
    """The first objective that every evaluation measures, by which a trial can be judged on the way; None if none."""
    return next((name for name in objectives if metric_of(name).kind in ("image", "signal")), None)
