"""Angles of gates as polynomials: of trainable weights, of input features, of products of both.

>>> w = Weights("w", (2, 3))
>>> angle = 0.5 * feature(2) * feature(3) + w[0, 1]
>>> angle
0.5*x[2]*x[3] + w[1]
>>> sorted(angle.features), angle - w[0, 1] == 0.5 * feature(2) * feature(3)
([2, 3], True)
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from math import isfinite, prod
from typing import Any, TypeAlias

Term: TypeAlias = tuple[float, tuple[tuple[str, int], ...], tuple[int, ...]]
"""A coefficient, the weights (name, flat index) and the features (index) that it is multiplied by."""


@dataclass(frozen=True)
class Expression:
    """A sum of `terms`; as an angle it is in radians. Sums, differences, products and integer powers are expressions.

    Raises:
        ValueError: a coefficient that is not finite, or a quotient or power that is not a polynomial.
    """

    terms: tuple[Term, ...] = ()

    @staticmethod
    def of(value: "Expression | float") -> "Expression":
        """The expression itself, or a constant."""
        if isinstance(value, Expression):
            return value
        number = float(value)
        if not isfinite(number):
            raise ValueError(f"an angle expects finite numbers, got {number}")
        return Expression(((number, (), ()),) if number else ())

    @cached_property
    def features(self) -> frozenset[int]:
        """The features that it depends on."""
        return frozenset(index for _, _, features in self.terms for index in features)

    @cached_property
    def weights(self) -> frozenset[tuple[str, int]]:
        """The weights that it depends on."""
        return frozenset(weight for _, weights, _ in self.terms for weight in weights)

    @property
    def constant(self) -> float | None:
        """Its value if it depends on nothing, else None."""
        if self.features or self.weights:
            return None
        return sum(coefficient for coefficient, _, _ in self.terms)

    def parts(self) -> "tuple[Expression, Expression]":
        """The terms without features, and those with features."""
        fixed = tuple(term for term in self.terms if not term[2])
        return Expression(fixed), Expression(tuple(term for term in self.terms if term[2]))

    def split_constant(self) -> "tuple[float, Expression]":
        """The constant term, and the other terms."""
        others = tuple(term for term in self.terms if term[1] or term[2])
        return sum(term[0] for term in self.terms if not (term[1] or term[2])), Expression(others)

    def __bool__(self) -> bool:
        return self != 0

    def __eq__(self, other: object) -> bool:
        """ValueError for a comparison with a number that depends on inputs or weights: a circuit has one form."""
        if isinstance(other, Expression):
            return self.terms == other.terms
        if not _is_operand(other):
            return NotImplemented
        if self.constant is None:
            raise ValueError("the form of a circuit cannot depend on the value of an input or a weight")
        return self.constant == other

    def __add__(self, other: Any) -> "Expression":
        if not _is_operand(other):
            return NotImplemented
        return _collected((*self.terms, *Expression.of(other).terms))

    def __mul__(self, other: Any) -> "Expression":
        if not _is_operand(other):
            return NotImplemented
        return _collected(
            (a * b, tuple(sorted(v + w)), tuple(sorted(x + y)))
            for a, v, x in self.terms
            for b, w, y in Expression.of(other).terms
        )

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> "Expression":
        return self * -1.0

    def __sub__(self, other: Any) -> "Expression":
        return self + -1.0 * other if _is_operand(other) else NotImplemented

    def __rsub__(self, other: Any) -> "Expression":
        return -self + other

    def __truediv__(self, other: Any) -> "Expression":
        if isinstance(other, Expression):
            raise ValueError("an angle is a polynomial of weights and features; it cannot divide by one of them")
        return self * (1.0 / float(other))

    def __pow__(self, power: Any) -> "Expression":
        if int(power) != power or power < 0:
            raise ValueError(f"an angle is a polynomial of weights and features; it cannot take the power {power}")
        out = Expression.of(1.0)
        for _ in range(int(power)):
            out = out * self
        return out

    def __pos__(self) -> "Expression":
        return self

    def __repr__(self) -> str:
        return " + ".join(_text(*term) for term in self.terms) or "0"


@dataclass(frozen=True)
class Weights:
    """A tensor of trainable weights with a name; `w[0, 1]` is the angle that its entry gives, `w[0]` a tuple of them.

    Args:
        name: of the parameter in the state_dict.
        shape: of the tensor, () for one number; an integer for a vector.
        initial: where all entries start; None draws each from [0, 2 pi).
    """

    name: str
    shape: tuple[int, ...]
    initial: float | None = None

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise ValueError(f"weights expect a name that is an identifier, got {self.name!r}")
        object.__setattr__(self, "shape", tuple(self.shape) if hasattr(self.shape, "__iter__") else (self.shape,))
        if any(isinstance(size, bool) or not isinstance(size, int) or size < 1 for size in self.shape):
            raise ValueError(f"weights {self.name} expect a shape of positive integers, got {self.shape}")

    @property
    def size(self) -> int:
        return prod(self.shape)

    def __len__(self) -> int:
        return self.shape[0] if self.shape else 1

    def __getitem__(self, index: int | tuple[int, ...]) -> Any:
        where = index if isinstance(index, tuple) else (index,)
        inside = all(hasattr(i, "__index__") and -s <= i < s for i, s in zip(where, self.shape, strict=False))
        if len(where) > len(self.shape) or not inside:
            raise IndexError(f"weights {self.name} have shape {self.shape}, got the index {index}")
        if len(where) < len(self.shape):
            return tuple(self[(*where, i)] for i in range(self.shape[len(where)]))
        flat = 0
        for i, size in zip(where, self.shape, strict=True):
            flat = flat * size + i % size
        return weight(self.name, flat)


def weight(name: str, index: int) -> Expression:
    """Entry `index` of the flattened weights with that name."""
    return Expression(((1.0, ((name, index),), ()),))


def feature(index: int) -> Expression:
    """Entry `index` of each sample's input."""
    return Expression(((1.0, (), (index,)),))


def _is_operand(value: Any) -> bool:
    if isinstance(value, Expression):
        return True
    try:
        float(value)
    except (TypeError, ValueError):
        return False
    return getattr(value, "ndim", 0) == 0


def _collected(terms: Iterable[Term]) -> Expression:
    """One term for each product of weights and features; those that cancel are gone."""
    sums: dict[Any, float] = {}
    for coefficient, weights, features in terms:
        if not isfinite(coefficient):
            raise ValueError(f"an angle expects finite numbers, got {coefficient}")
        sums[weights, features] = sums.get((weights, features), 0.0) + coefficient
    return Expression(tuple((value, *key) for key, value in sums.items() if value))


def _text(coefficient: float, weights: tuple[tuple[str, int], ...], features: tuple[int, ...]) -> str:
    factors = [*(f"x[{index}]" for index in features), *(f"{name}[{index}]" for name, index in weights)]
    return "*".join([*([f"{coefficient:g}"] if coefficient != 1 or not factors else []), *factors])
