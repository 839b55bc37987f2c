"""What a search looks for: a number of a run's summary, with its better direction."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from qnerf.config.checks import is_number
from qnerf.metrics import HEAD_PARAMETERS, METRICS, metric_of
from qnerf.records import filters

Direction = Literal["maximize", "minimize"]
KNOWN = tuple(key for key, item in METRICS.items() if item.kind != "loss" and (item.better or item.kind == "size"))


def check(objective: str) -> None:
    """ValueError unless the objective is a number of which it is known which way is better."""
    if objective not in KNOWN:
        raise ValueError(f"unknown objective {objective!r}; known: {', '.join(KNOWN)}")


def limits(constraints: Sequence[str]) -> list[filters.Filter]:
    """`params.heads<=500` and its like; ValueError for anything but a column, < or > or with =, and a number."""
    found = filters.parse(constraints)
    if wrong := [text for text, limit in zip(constraints, found, strict=False) if limit.operator[0] not in "<>"]:
        raise ValueError(f"hydra.sweeper.constraints: expected such as params.heads<=500, got {wrong[0]!r}")
    return found


def violation(limit: filters.Filter, number: float) -> float:
    """By how much the number violates the limit, as Optuna counts it: above 0 where it does."""
    excess = number - float(limit.values[0])
    excess = excess if limit.operator[0] == "<" else -excess
    return excess if "=" in limit.operator or excess else 1e-12


def direction(objective: str) -> Direction:
    """Fewer parameters, less time and less memory are better; the metrics of images say themselves.

    >>> direction("psnr"), direction("params.total")
    ('maximize', 'minimize')
    """
    return "maximize" if metric_of(objective).better == "higher" else "minimize"


def columns(number: str) -> tuple[str, ...]:
    """The columns of summary.parquet that an objective, or what a constraint is about, is computed from."""
    return HEAD_PARAMETERS if number == "params.heads" else (number,)


def value(summary: Mapping[str, Any], objective: str) -> float | None:
    """The objective of a run; None if its summary has no number for it."""
    found = [float(number) for name in columns(objective) if is_number(number := summary.get(name))]
    return sum(found) if found else None


def is_judged(objective: str) -> bool:
    """Whether every evaluation measures it, so that a trial can be judged on the way."""
    return metric_of(objective).kind in ("image", "signal")
