"""Gates as data: every gate is a product of rotations exp(-i angle/2 P) about Pauli words P, up to a global phase.

A Clifford gate is a product of such rotations by multiples of pi/2, so one table holds fixed and parametrised gates:

>>> GATES["CRX"].rotations
(PauliRotation(letters='IX', constant=0.0, factor=0.5, angle=0), PauliRotation(letters='ZX', constant=0.0, factor=-0.5, angle=0))
>>> sum(abs(rotation.constant) for rotation in GATES["H"].rotations) / pi  # RY(pi/2), then X
1.5
"""  # noqa: E501

from dataclasses import dataclass
from itertools import product
from math import pi
from operator import index
from typing import Any, NamedTuple

from qnerf.quantum.expressions import Expression


class PauliRotation(NamedTuple):
    """A rotation about `letters`, one of I, X, Y, Z for each wire, by `constant` + `factor` times an angle."""

    letters: str
    constant: float = 0.0
    factor: float = 0.0
    angle: int = 0


class GateKind(NamedTuple):
    """What a gate takes, and the rotations that it consists of, in the order in which they act."""

    wires: int
    angles: int
    rotations: tuple[PauliRotation, ...]


def _fixed(*rotations: tuple[str, float]) -> GateKind:
    return GateKind(len(rotations[0][0]), 0, tuple(PauliRotation(letters, angle) for letters, angle in rotations))


def _turned(*rotations: tuple[str, float, int]) -> GateKind:
    angles = max(angle for _, _, angle in rotations) + 1
    return GateKind(len(rotations[0][0]), angles, tuple(PauliRotation(word, 0.0, f, k) for word, f, k in rotations))


def _minus_projector(letters: str, scale: float) -> list[tuple[str, float]]:
    """(word, angle) of exp(i scale P), where P projects on the eigenvalue -1 of every letter."""
    size = len(letters)
    words = ("".join(word) for word in product(*(("I", letter) for letter in letters)))
    return [(word, -2 * scale / 2**size * (-1) ** (size - word.count("I"))) for word in words if set(word) != {"I"}]


def _projected(signs: tuple[int, int]) -> GateKind:
    """A phase on one of the states 00, 01, 10, 11, given by the signs of Z on each wire."""
    a, b = signs
    return _turned(("ZI", -a / 2, 0), ("IZ", -b / 2, 0), ("ZZ", -a * b / 2, 0))


def _controlled(letter: str, angle: int = 0) -> tuple[tuple[str, float, int], ...]:
    return (f"I{letter}", 0.5, angle), (f"Z{letter}", -0.5, angle)


_CNOT_21 = [("I" + word[::-1], angle) for word, angle in _minus_projector("ZX", pi)]

GATES: dict[str, GateKind] = {
    "X": _fixed(("X", pi)),
    "Y": _fixed(("Y", pi)),
    "Z": _fixed(("Z", pi)),
    "H": _fixed(("Y", pi / 2), ("X", pi)),
    "S": _fixed(("Z", pi / 2)),
    "T": _fixed(("Z", pi / 4)),
    "SX": _fixed(("X", pi / 2)),
    "CNOT": _fixed(*_minus_projector("ZX", pi)),
    "CY": _fixed(*_minus_projector("ZY", pi)),
    "CZ": _fixed(*_minus_projector("ZZ", pi)),
    "CH": _fixed(("IY", -pi / 4), *_minus_projector("ZZ", pi), ("IY", pi / 4)),
    "SWAP": _fixed(("XX", -pi / 2), ("YY", -pi / 2), ("ZZ", -pi / 2)),
    "ISWAP": _fixed(("XX", -pi / 2), ("YY", -pi / 2)),
    "SISWAP": _fixed(("XX", -pi / 4), ("YY", -pi / 4)),
    "Toffoli": _fixed(*_minus_projector("ZZX", pi)),
    "CCZ": _fixed(*_minus_projector("ZZZ", pi)),
    "CSWAP": _fixed(*_CNOT_21, *_minus_projector("ZZX", pi), *_CNOT_21),
    "RX": _turned(("X", 1.0, 0)),
    "RY": _turned(("Y", 1.0, 0)),
    "RZ": _turned(("Z", 1.0, 0)),
    "PhaseShift": _turned(("Z", 1.0, 0)),
    "Rot": _turned(("Z", 1.0, 0), ("Y", 1.0, 1), ("Z", 1.0, 2)),
    "U1": _turned(("Z", 1.0, 0)),
    "U2": GateKind(
        1, 2, (PauliRotation("Z", 0.0, 1.0, 1), PauliRotation("Y", pi / 2), PauliRotation("Z", 0.0, 1.0, 0))
    ),
    "U3": _turned(("Z", 1.0, 2), ("Y", 1.0, 0), ("Z", 1.0, 1)),
    "CRX": _turned(*_controlled("X")),
    "CRY": _turned(*_controlled("Y")),
    "CRZ": _turned(*_controlled("Z")),
    "CRot": _turned(*_controlled("Z", 0), *_controlled("Y", 1), *_controlled("Z", 2)),
    "ControlledPhaseShift": _projected((-1, -1)),
    "CPhaseShift00": _projected((1, 1)),
    "CPhaseShift01": _projected((1, -1)),
    "CPhaseShift10": _projected((-1, 1)),
    "IsingXX": _turned(("XX", 1.0, 0)),
    "IsingYY": _turned(("YY", 1.0, 0)),
    "IsingZZ": _turned(("ZZ", 1.0, 0)),
    "IsingXY": _turned(("XX", -0.5, 0), ("YY", -0.5, 0)),
    "SingleExcitation": _turned(("YX", 0.5, 0), ("XY", -0.5, 0)),
    "DoubleExcitation": _turned(
        *(
            (word, sign / 8, 0)
            for word, sign in {
                "XXXY": -1, "XXYX": -1, "XYXX": 1, "YXXX": 1, "XYYY": -1, "YXYY": -1, "YYXY": 1, "YYYX": 1
            }.items()
        )
    ),
    "MultiRZ": GateKind(0, 1, ()),
    "PauliRot": GateKind(0, 1, ()),
}  # fmt: skip
"""The gates by PennyLane's short names. MultiRZ and PauliRot take any number of wires, so `wires` is 0."""

SHORT_NAMES = {"Hadamard": "H", "PauliX": "X", "PauliY": "Y", "PauliZ": "Z"}
"""PennyLane's longer names."""


def as_wires(what: str, wires: Any) -> tuple[int, ...]:
    """A tuple of wires, from one wire or several.

    >>> as_wires("RX", 2), as_wires("CNOT", [0, 1])
    ((2,), (0, 1))

    Raises:
        ValueError: a wire that is not an integer.
    """
    if type(wires) is tuple and all(type(wire) is int for wire in wires):
        return wires
    try:
        return tuple(map(index, wires)) if hasattr(wires, "__iter__") else (index(wires),)
    except TypeError:
        raise ValueError(f"{what} expects wires as integers from 0, got {wires!r}") from None


@dataclass(frozen=True)
class Gate:
    """A gate of `GATES` on its wires (controls first), with an angle in radians for each parameter.

    >>> from qnerf.quantum.expressions import feature
    >>> Gate("CRX", (0, 1), (feature(3),))
    Gate(name='CRX', wires=(0, 1), angles=(x[3],), word='')

    Args:
        name: a name in `GATES`, or one of PennyLane's longer names.
        wires: all different; one wire may stand alone.
        angles: expressions or numbers, one for each parameter of the gate; one may stand alone.
        word: of PauliRot, a letter of X, Y, Z, I for each wire.

    Raises:
        ValueError: an unknown name, or a wrong number of wires, angles or letters.
    """

    name: str
    wires: tuple[int, ...]
    angles: tuple[Expression | float, ...] = ()
    word: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", SHORT_NAMES.get(self.name, self.name))
        object.__setattr__(self, "wires", as_wires(self.name, self.wires))
        if isinstance(self.angles, Expression) or not hasattr(self.angles, "__len__"):
            object.__setattr__(self, "angles", (self.angles,))
        if self.name not in GATES:
            raise ValueError(f"unknown gate {self.name!r}; known: {', '.join(GATES)}")
        kind = GATES[self.name]
        if kind.wires and len(self.wires) != kind.wires:
            raise ValueError(f"{self.name} expects {kind.wires} wires, got {self.wires}")
        if not self.wires or len(set(self.wires)) != len(self.wires):
            raise ValueError(f"{self.name} expects different wires, got {self.wires}")
        if len(self.angles) != kind.angles:
            raise ValueError(f"{self.name} expects {kind.angles} angles, got {len(self.angles)}")
        if (self.name == "PauliRot") != bool(self.word) or set(self.word) - set("IXYZ"):
            raise ValueError(f"{self.name} got the Pauli word {self.word!r}; PauliRot alone takes one, of I, X, Y, Z")
        if self.word and len(self.word) != len(self.wires):
            raise ValueError(f"PauliRot expects a letter for each of the wires {self.wires}, got {self.word!r}")
        object.__setattr__(self, "angles", tuple(Expression.of(angle) for angle in self.angles))

    @property
    def rotations(self) -> tuple[PauliRotation, ...]:
        """The rotations that the gate consists of."""
        if self.name in ("MultiRZ", "PauliRot"):
            return (PauliRotation(self.word or "Z" * len(self.wires), 0.0, 1.0, 0),)
        return GATES[self.name].rotations

    def angle_of(self, rotation: PauliRotation) -> Expression:
        """The angle of one of its rotations."""
        if not rotation.factor:
            return Expression.of(rotation.constant)
        angle = Expression.of(self.angles[rotation.angle])
        return angle if rotation.factor == 1 and not rotation.constant else angle * rotation.factor + rotation.constant


@dataclass(frozen=True)
class Amplitudes:
    """The state of `wires` at the start: amplitudes proportional to `real` + i `imaginary`, 2^k for k wires.

    The first wire is the most significant bit. Nothing may act on the wires before.

    Args:
        wires: all different.
        real: expressions or numbers.
        imaginary: the same; () for real amplitudes.

    Raises:
        ValueError: a wrong number of amplitudes.
    """

    wires: tuple[int, ...]
    real: tuple[Expression | float, ...]
    imaginary: tuple[Expression | float, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "wires", as_wires("amplitudes", self.wires))
        size = 2 ** len(self.wires)
        if not self.wires or len(set(self.wires)) != len(self.wires):
            raise ValueError(f"amplitudes expect different wires, got {self.wires}")
        for part in ("real", "imaginary"):
            values = getattr(self, part)
            if len(values) != size and (values or part == "real"):
                raise ValueError(f"amplitudes of {len(self.wires)} wires expect {size} values, got {len(values)}")
            object.__setattr__(self, part, tuple(Expression.of(value) for value in values))

    @property
    def angles(self) -> tuple[Expression | float, ...]:
        """All expressions in it."""
        return self.real + self.imaginary
