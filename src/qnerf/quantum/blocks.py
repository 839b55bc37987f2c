"""The blocks of a program: what each of them does and costs, and which rotations and CNOTs can pass it."""

import operator
from collections.abc import Iterable
from dataclasses import dataclass, field

from qnerf.quantum.expressions import Expression
from qnerf.quantum.words import Word, through_cnot

TURN_COST, LAYER_COST, TILT_COST, CNOT_COST = 19, 8, 2, 8
"""Multiply-adds for each amplitude, forward and backward, or what takes as long: of a turn, of a wire in a layer of RY
or of tilts, of a permutation."""


@dataclass
class _Rotations:
    """One angle for each key, the wires of its rotation as bits."""

    angles: dict[int, Expression] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.touched = union(Word(0, mask, 0) for mask in self.angles)[1]

    def add(self, word: Word, angle: Expression) -> None:
        add_angle(self.angles, word.support, angle)
        self.touched |= word.support

    def passes_cnot(self, control: int, target: int) -> bool:
        return not self.touched & (control | target)


class Diagonal(_Rotations):
    """exp(-i/2 sum_m angles[m] Z_m) for products of Z on the wires of each mask m."""

    def commutes(self, word: Word) -> bool:
        return not word.x & self.touched or all((word.x & mask).bit_count() % 2 == 0 for mask in self.angles)

    def passes_cnot(self, control: int, target: int) -> bool:
        return not self.touched & target

    @property
    def joins_cnots(self) -> bool:
        """Whether engines apply it together with CNOTs: constants, and fixed phases of one wire each."""
        one_wire = (mask.bit_count() == 1 and not angle.features for mask, angle in self.angles.items())
        constant = (angle.constant is not None for angle in self.angles.values())
        return all(map(operator.or_, one_wire, constant))


class RYLayer(_Rotations):
    """RY(angles[bit]) on the wire of each bit. No angle depends on the input."""

    def commutes(self, word: Word) -> bool:
        return not (word.x ^ word.z) & self.touched


class Tilts(_Rotations):
    """RX(angles[bit]) on the wire of each bit. Every angle is 0 and has derivatives (`angles.Products`)."""

    def commutes(self, word: Word) -> bool:
        return not word.z & self.touched


@dataclass
class CNOTs:
    """CNOT(control, target) for each pair of bits, in this order."""

    pairs: list[tuple[int, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.controls, self.targets = union(Word(*pair, 0) for pair in self.pairs)

    def commutes(self, word: Word) -> bool:
        return not (word.z & self.targets or word.x & self.controls)

    def turned(self, word: Word) -> Word:
        """The word before the CNOTs that equals this one behind them."""
        for control, target in reversed(self.pairs):
            word = through_cnot(word, control, target)
        return word

    def append(self, control: int, target: int) -> None:
        self.pairs.append((control, target))
        self.controls, self.targets = self.controls | control, self.targets | target

    def passes_cnot(self, control: int, target: int) -> bool:
        return not (self.controls & target or self.targets & control)


@dataclass
class Turn:
    """exp(-i angle/2 word)."""

    word: Word
    angle: Expression

    def commutes(self, word: Word) -> bool:
        return self.word.commutes(word)

    def add(self, word: Word, angle: Expression) -> None:
        self.angle = self.angle + angle

    def passes_cnot(self, control: int, target: int) -> bool:
        return not (self.word.z & target or self.word.x & control)


Block = Diagonal | RYLayer | Tilts | CNOTs | Turn


def rotations_of(block: Block, n: int) -> list[tuple[Word, Expression]]:
    """The rotations of a block, which commute; none for CNOTs."""
    if isinstance(block, Diagonal):
        return [(Word(0, mask, 0), angle) for mask, angle in block.angles.items()]
    if isinstance(block, RYLayer | Tilts):
        own = isinstance(block, RYLayer)
        return [(Word(bit, bit * own, int(own)), angle) for bit, angle in block.angles.items()]
    return [(block.word, block.angle)] if isinstance(block, Turn) else []


def moves(block: Block) -> bool:
    """Whether a block depends on the input."""
    if isinstance(block, Turn):
        return bool(block.angle.features)
    return isinstance(block, Diagonal) and any(angle.features for angle in block.angles.values())


def traced(block: Block, x: int, z: int) -> tuple[Block | None, int, int]:
    """What of a block has an effect on an observable behind it, and where the observable may act before the block.

    The observable may act as X or Y on the wires x, as Z or Y on the wires z. So the answer may be too large, never too
    small. Wires are bits.
    """
    if isinstance(block, CNOTs):
        pairs = []
        for control, target in reversed(block.pairs):
            if x & control or z & target:
                pairs.append((control, target))
                x, z = x | (target if x & control else 0), z | (control if z & target else 0)
        return (CNOTs(pairs[::-1]) if pairs else None), x, z
    if isinstance(block, Turn):
        if not block.angle.terms or not (block.word.x & z or block.word.z & x):
            return None, x, z
        return block, x | block.word.x, z | block.word.z
    near = x if isinstance(block, Diagonal) else x | z
    angles = {mask: angle for mask, angle in block.angles.items() if mask & near}
    met = union(Word(0, mask, 0) for mask in angles)[1]
    return (type(block)(angles) if angles else None), x | (0 if isinstance(block, Diagonal) else met), z | met


def turn_phases(block: Diagonal, control: int, target: int) -> None:
    """The phases between two equal CNOTs as phases without them."""
    angles = block.angles
    block.angles = {}
    for mask, angle in angles.items():
        block.add(Word(0, mask ^ control if mask & target else mask, 0), angle)


def add_angle(angles: dict[int, Expression], key: int, angle: Expression) -> None:
    total = angles[key] + angle if key in angles else angle
    if total.terms:
        angles[key] = total
    else:
        del angles[key]


def union(words: Iterable[Word]) -> tuple[int, int]:
    x = z = 0
    for word in words:
        x, z = x | word.x, z | word.z
    return x, z


def merged(blocks: Iterable[Block]) -> list[Block]:
    """The blocks, neighbours of one kind as one."""
    out: list[Block] = []
    for block in blocks:
        last = out[-1] if out else None
        if isinstance(block, Diagonal | RYLayer | Tilts) and type(last) is type(block):
            for mask, angle in block.angles.items():
                last.add(Word(0, mask, 0), angle)
        else:
            out.append(block)
    return out


def cost_of(block: Block, n: int) -> int:
    """Multiply-adds of the block for each amplitude of n wires, forward and backward."""
    if isinstance(block, RYLayer):
        return LAYER_COST * n
    if isinstance(block, Tilts):
        return TILT_COST * n
    if isinstance(block, CNOTs):
        return CNOT_COST
    if isinstance(block, Turn):
        return TURN_COST
    several = sum(mask.bit_count() > 1 and not angle.constant for mask, angle in block.angles.items())
    return (25 if moves(block) else 13) + (n + 6 * several if several else 0)
