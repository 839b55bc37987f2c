"""Rotations of one wire, one after the other, and angles that are multiples of pi."""

from math import pi

from qnerf.quantum.expressions import Expression
from qnerf.quantum.words import Word

TOLERANCE = 1e-13  # an angle this near to a multiple of pi, in units of pi, is one
LARGEST_MULTIPLE = 64  # beyond, the rounding of the angle says nothing about multiples of pi

Factors = tuple[tuple[Word, Expression], ...]
Product = list[tuple[Word, Expression]]


def append(factors: Product, word: Word, angle: Expression) -> None:
    """Adds a rotation of one wire; one about the same word as the last one merges with it."""
    if factors and factors[-1][0] == word:
        angle = factors.pop()[1] + angle
    if angle.terms:
        factors.append((word, angle))


def with_moving_phases(factors: Product) -> Product:
    """The rotations of one wire, those by data about Z alone.

    RX(a) = RY(pi/2) RZ(a) RY(-pi/2) and RY(a) = RZ(pi/2) RX(a) RZ(-pi/2), by an angle that depends on data.
    """
    out: Product = []
    quarter = Expression.of(pi / 2)
    for word, angle in factors:
        if not (word.x and angle.features):
            append(out, word, angle)
            continue
        y, z = Word(word.x, word.x, 1), Word(0, word.x, 0)
        own = quarter if word.z else Expression()
        for part, turn in ((z, -own), (y, -quarter), (z, angle), (y, quarter), (z, own)):
            append(out, part, turn)
    return out


def half_turns(angle: Expression) -> int | None:
    """The angle as a multiple of pi if it is one, else None."""
    constant = angle.constant
    if constant is None:
        return None
    whole = round(constant / pi)
    return whole if abs(constant / pi - whole) <= TOLERANCE and abs(whole) <= LARGEST_MULTIPLE else None
