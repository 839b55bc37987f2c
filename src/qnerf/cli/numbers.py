"""Types of numbers on the command line, for `argparse`: finite, and within what the command can do with them."""

import argparse
import math
from collections.abc import Callable
from typing import Any

MAX_COUNT = 10**9


def number(low: float, high: float, *, above: bool = False, kind: type = float) -> Callable[[str], Any]:
    """A finite number from `low` to `high`; above: `low` itself is refused; kind: int for whole numbers."""

    def parse(text: str) -> Any:
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high or (above and value == low):
            what = f"a {'whole ' * (kind is int)}number {'above' if above else 'from'} {low:,g} to {high:,g}"
            raise argparse.ArgumentTypeError(f"expected {what}, got {text!r:.60}")
        return value

    return parse


def whole(low: int, high: int) -> Callable[[str], int]:
    """A whole number from `low` to `high`."""
    return number(low, high, kind=int)


count = whole(0, MAX_COUNT)
