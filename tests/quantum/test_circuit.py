"""The circuit as data, its drawings, and its program."""

import pytest

from qnerf.quantum.blocks import Diagonal, RYLayer, rotations_of
from qnerf.quantum.circuit import ANSATZE, Circuit, Weights, encoding, rotations
from qnerf.quantum.cones import TooLarge, find_cones
from qnerf.quantum.pennylane import draw
from qnerf.quantum.program import program


def test_drawing_in_the_docstring_is_that_of_pennylane():
    documented = [line.strip() for line in (ANSATZE.get("qiren").__doc__ or "").splitlines()]
    first = next(index for index, line in enumerate(documented) if line.startswith("0: "))
    assert documented[first : first + 3] == draw(ANSATZE.build("qiren", 3, 1)).splitlines()


def test_program_of_qiren_leaves_out_what_does_not_matter():
    found = program(ANSATZE.build("qiren", 8, 3))
    kinds = [type(block) for block in found.blocks]
    assert kinds == [RYLayer, *[Diagonal, RYLayer] * 7]  # one diagonal between any two RY layers, nothing at the ends
    weights = [w for block in found.blocks for _, angle in rotations_of(block, 8) for w in angle.weights]
    assert len(weights) == len(set(weights)) == (8 * 3 - 2) * 8
    assert ("weights1", 0) not in weights  # phi of the first sublayer: a global phase
    assert ("weights2", 2 * 8 * 3 - 1) not in weights  # omega of the last: commutes with Z
    assert found.fixed_blocks == 3
    assert found.measures_last_layer


def test_cones_of_qiren():
    cones = find_cones(program(ANSATZE.build("qiren", 8, 1))).cones
    assert [cone.features for cone in cones[:2]] == [(0, 1, 7), (0, 1, 2)]
    assert {cone.coefficients for cone in cones} == {27}
    assert find_cones(program(ANSATZE.build("ternary", 2, 2))).cones[0].degrees == (4, 4)
    with pytest.raises(TooLarge, match=r"8 wires depends on 8 inputs.*choose method=statevector"):
        find_cones(program(ANSATZE.build("qiren", 8, 2)))


def test_cones_need_scales_with_a_common_unit():
    w = Weights("w", (3, 1, 3))
    operations = (
        *rotations(w[0]),
        *encoding("Z", (1.0,)),
        *rotations(w[1]),
        *encoding("Z", (2**0.5,)),
        *rotations(w[2]),
    )
    circuit = Circuit("odd", 1, operations, (((0, "Z"),),), weights=(w,))
    with pytest.raises(TooLarge, match="no common unit"):
        find_cones(program(circuit))
