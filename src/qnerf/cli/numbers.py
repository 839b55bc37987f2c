"""Types of numbers on the command line, for `argparse`: finite, and within what the command can do with them."""

import argparse
import math
from collections.abc import Callable

MAX_COUNT = 10**9


def number(low: float, high: float, *, above: bool = False) -> Callable[[str], float]:
    """A finite number from `low` to `high`; above: `low` itself is refused."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high or (above and value == low):
            start = f"above {low:g}" if above else f"from {low:g}"
            raise argparse.ArgumentTypeError(f"expected a number {start} to {high:g}, got {text!r:.60}")
        return value

    return parse


def whole(low: int, high: int) -> Callable[[str], int]:
    """A whole number from `low` to `high`."""

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = low - 1
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"expected a whole number from {low:,} to {high:,}, got {text!r:.60}")
        return value

    return parse


count = whole(0, MAX_COUNT)
