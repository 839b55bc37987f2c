"""The space of a search: which values a trial may give to each option."""

import itertools
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution

from qnerf.config.checks import is_number

DIGITS = 4  # significant digits of a number that a search draws

Point = tuple[str, ...]
"""The value of each option, as typed on the command line, in the order of the space."""


@dataclass(frozen=True)
class Choices:
    """A list of values. Numbers are in order for the sampler, anything else is not.

    texts: as typed; values: what they stand for.

    >>> layers = Choices(("4", "1", "2"), (4, 1, 2))
    >>> layers.text(0), layers.find(2.0), layers.find(3)
    ('1', '2', None)
    """

    texts: tuple[str, ...]
    values: tuple[Any, ...]

    @property
    def ordered(self) -> bool:
        return all(map(is_number, self.values))

    @property
    def size(self) -> float:
        return len(self.texts)

    def __iter__(self) -> Iterator[str]:
        if not self.ordered:
            return iter(self.texts)
        return iter([text for _, text in sorted(zip(self.values, self.texts, strict=True))])

    def distribution(self) -> BaseDistribution:
        return IntDistribution(0, len(self.texts) - 1) if self.ordered else CategoricalDistribution(self.texts)

    def text(self, drawn: Any) -> str:
        return list(self)[drawn] if self.ordered else str(drawn)

    def drawn(self, text: str) -> Any:
        return list(self).index(text) if self.ordered else text

    def find(self, stored: Any) -> str | None:
        """The choice that a run's stored value is; None if it is none. Lists are stored as JSON."""
        stored = None if isinstance(stored, float) and math.isnan(stored) else stored
        for text, value in zip(self.texts, self.values, strict=True):
            if stored == value or (isinstance(value, (list, dict)) and stored == json.dumps(value)):
                return text
        return None


@dataclass(frozen=True)
class Interval:
    """All numbers from `low` to `high`, both included. A search draws them with `DIGITS` significant digits.

    log: evenly in the logarithm. integer: whole numbers only.

    >>> Interval(1e-4, 1e-2, log=True).text(0.00123456)
    '0.001235'
    """

    low: float
    high: float
    log: bool = False
    integer: bool = False

    @property
    def size(self) -> float:
        return self.high - self.low + 1 if self.integer else 1 if self.low == self.high else math.inf

    def __iter__(self) -> Iterator[str]:
        """ValueError unless the values can be counted."""
        if self.size == math.inf:
            raise ValueError("an interval has no end of values")
        return map(str, range(int(self.low), int(self.high) + 1) if self.integer else [self.low])

    def distribution(self) -> BaseDistribution:
        if self.integer:
            return IntDistribution(int(self.low), int(self.high), log=self.log)
        return FloatDistribution(self.low, self.high, log=self.log)

    def text(self, drawn: float) -> str:
        if self.integer:
            return str(int(drawn))
        return repr(min(max(float(f"{drawn:.{DIGITS}g}"), self.low), self.high))

    def drawn(self, text: str) -> float:
        return int(text) if self.integer else float(text)

    def find(self, stored: Any) -> str | None:
        """The stored value as text; None if it is outside the interval."""
        if not is_number(stored) or not self.low <= stored <= self.high or (self.integer and stored != int(stored)):
            return None
        return str(int(stored)) if self.integer else repr(float(stored))


Space = Mapping[str, Choices | Interval]
"""Option -> its values."""


def size(space: Space) -> float:
    """How many points a space has; infinite if it has an interval of real numbers."""
    return math.prod(values.size for values in space.values())


def points(space: Space) -> Iterator[Point]:
    """Every point of a space of finite size."""
    return itertools.product(*space.values())


def random_point(space: Space, rng: np.random.Generator) -> Point:
    """A point drawn uniformly, in the logarithm where the interval says so."""

    def draw(values: Choices | Interval) -> str:
        if isinstance(values, Choices):
            return values.texts[rng.integers(len(values.texts))]
        if values.integer:
            return str(rng.integers(int(values.low), int(values.high) + 1))
        low, high = (math.log(values.low), math.log(values.high)) if values.log else (values.low, values.high)
        drawn = rng.uniform(low, high)
        return values.text(math.exp(drawn) if values.log else drawn)

    return tuple(map(draw, space.values()))


def overrides(space: Space, point: Point) -> list[str]:
    """The point as overrides of the command line."""
    return [f"{option}={text}" for option, text in zip(space, point, strict=True)]
