"""A curve as one line of text."""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

BLOCKS = "▁▂▃▄▅▆▇█"


def sparkline(values: Sequence[float] | np.ndarray, width: int) -> str:
    """`values` as at most `width` characters: the lowest block is the smallest value, the highest the largest.

    More values than characters are averaged. A space stands for values that are all NaN or infinite.

    >>> sparkline([0, 1, 2, 3, 2, 1], 6)
    '▁▃▆█▆▃'
    """
    width = min(width, len(values))
    bounds = [len(values) * i // max(width, 1) for i in range(width + 1)]
    means = [_mean(values[a:b]) for a, b in pairwise(bounds)]
    finite = [value for value in means if value is not None]
    if not finite:
        return " " * width
    low, high = min(finite), max(finite)
    scale = (len(BLOCKS) - 1) / (high - low) if high > low else 0.0
    return "".join(" " if value is None else BLOCKS[round((value - low) * scale)] for value in means)


def _mean(values: Sequence[float] | np.ndarray) -> float | None:
    finite = [value for value in values if math.isfinite(value)]
    return sum(value / len(finite) for value in finite) if finite else None
