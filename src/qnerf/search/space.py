"""The space of a search: which values a trial may give to each option."""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution

DIGITS = 4  # significant digits of a number that a search draws

Point = tuple[str, ...]
"""The value of each option, as typed on the command line, in the order of the space."""


@dataclass(frozen=True)
class Choices:
    """A list of values as they are typed. Numbers are sorted, and the sampler knows that they are in order.

    >>> layers = Choices.of(["4", "1", "2"])
    >>> layers.text(0), layers.find("2.0"), layers.find("3")
    ('1', '2', None)
    """

    texts: tuple[str, ...]
    ordered: bool = False

    @classmethod
    def of(cls, texts: Sequence[str]) -> "Choices":
        """The different values among `texts`; 1 and 1.0 are the same."""
        numbers = {text: number for text in texts if (number := _number(text)) is not None}
        if len(numbers) < len(set(texts)):
            return cls(tuple(dict.fromkeys(texts)))
        first = {number: text for text, number in reversed(numbers.items())}
        return cls(tuple(first[number] for number in sorted(first)), ordered=True)

    def distribution(self) -> BaseDistribution:
        return IntDistribution(0, len(self.texts) - 1) if self.ordered else CategoricalDistribution(self.texts)

    def text(self, drawn: int | str) -> str:
        return self.texts[int(drawn)] if self.ordered else str(drawn)

    def drawn(self, text: str) -> int | str:
        return self.texts.index(text) if self.ordered else text

    def find(self, typed: str) -> str | None:
        """The choice that `typed` stands for; None if it is another value."""
        return next((text for text in self.texts if _same(text, typed)), None)


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

    def find(self, typed: str) -> str | None:
        """The number that `typed` stands for; None if it is outside the interval."""
        number = _number(typed)
        if number is None or not self.low <= number <= self.high or (self.integer and not number.is_integer()):
            return None
        return str(int(number)) if self.integer else repr(number)


Space = Mapping[str, Choices | Interval]
"""Option -> its values."""


def overrides(space: Space, point: Point) -> list[str]:
    """The point as overrides of the command line."""
    return [f"{option}={text}" for option, text in zip(space, point, strict=True)]


def _number(text: str) -> float | None:
    with contextlib.suppress(ValueError):
        return float(text)
    return None


def _same(one: str, other: str) -> bool:
    number = _number(one)
    return one.replace(" ", "") == other.replace(" ", "") or (number is not None and number == _number(other))
