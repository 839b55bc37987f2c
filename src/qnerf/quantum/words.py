"""Pauli words as bits, and what gates of the Clifford group make of them."""

from collections.abc import Iterable
from typing import NamedTuple


class Word(NamedTuple):
    """i^phase X^x Z^z on `wires` wires; wire 0 is the most significant bit of x and z, as of a basis state.

    >>> word = Word.of("ZY", (0, 2), 3)
    >>> f"{word.x:03b} {word.z:03b}", word.sign, word.commutes(Word.of("X", (0,), 3))
    ('001 101', 1, False)
    """

    x: int
    z: int
    phase: int

    @staticmethod
    def of(letters: Iterable[str], wires: Iterable[int], n: int) -> "Word":
        """The product of `letters` on `wires` of n."""
        x = z = 0
        for letter, wire in zip(letters, wires, strict=True):
            x |= (letter in "XY") << (n - 1 - wire)
            z |= (letter in "ZY") << (n - 1 - wire)
        return Word(x, z, (x & z).bit_count() % 4)

    def __mul__(self, other: "Word") -> "Word":  # type: ignore[override]
        sign = 2 * (self.z & other.x).bit_count()
        return Word(self.x ^ other.x, self.z ^ other.z, (self.phase + other.phase + sign) % 4)

    def commutes(self, other: "Word") -> bool:
        return ((self.x & other.z).bit_count() + (self.z & other.x).bit_count()) % 2 == 0

    @property
    def sign(self) -> int:
        """+1 or -1, the sign of a Hermitian word in front of its letters."""
        return 1 - (self.phase - (self.x & self.z).bit_count()) % 4

    @property
    def letters(self) -> "Word":
        """A Hermitian word with the sign +1."""
        return Word(self.x, self.z, (self.x & self.z).bit_count() % 4)

    @property
    def support(self) -> int:
        """The wires that it acts on, as bits."""
        return self.x | self.z


def bits(mask: int) -> list[int]:
    """The single bits of a mask, the most significant first.

    >>> bits(0b1010)
    [8, 2]
    """
    return [1 << place for place in range(mask.bit_length() - 1, -1, -1) if mask >> place & 1]


def through_cnot(word: Word, control: int, target: int) -> Word:
    """CNOT word CNOT: X spreads from the control to the target, Z from the target to the control. Wires are bits."""
    out = Word(word.x, word.z, word.phase)
    if word.x & control:
        out = Word(out.x ^ target, out.z, out.phase)
    if word.z & target:
        out = Word(out.x, out.z ^ control, out.phase)
    return out
