"""The circuit as data, its drawings, and its normal form."""

import numpy as np
import pytest

from qnerf.quantum.circuit import ANSATZE, Circuit, Encoding, Entangler, Rotations, ring
from qnerf.quantum.cones import TooLarge, find_cones
from qnerf.quantum.normal_form import CNOTs, Diagonal, RYLayer, cnot_permutation, cz_signs, normal_form
from qnerf.quantum.pennylane import draw


def test_qiren_is_strongly_entangling_layers_with_cz() -> None:
    circuit = ANSATZE.build("qiren", 8, 2)
    kinds = [type(operation).__name__ for operation in circuit.operations]
    assert kinds == [*["Rotations", "Entangler"] * 2, "Encoding"] * 2 + ["Rotations", "Entangler"] * 2
    entanglers = [operation for operation in circuit.operations if isinstance(operation, Entangler)]
    assert entanglers[0].pairs == ring(8, 1)
    assert entanglers[1].pairs == ring(8, 2)
    assert circuit.weight_shapes == ((2, 2, 8, 3), (2, 8, 3))


def test_drawing_in_the_docstring_is_that_of_pennylane() -> None:
    documented = [line.strip() for line in (ANSATZE.get("qiren").__doc__ or "").splitlines()]
    first = next(index for index, line in enumerate(documented) if line.startswith("0: "))
    assert documented[first : first + 3] == draw(ANSATZE.build("qiren", 3, 1)).splitlines()


def test_normal_form_drops_what_does_not_matter() -> None:
    form = normal_form(ANSATZE.build("qiren", 8, 3))
    kinds = [type(step) for step in form.steps]
    assert kinds == [RYLayer, *[Diagonal, RYLayer] * 7]  # one diagonal between any two RY layers, nothing at the ends
    weights = [weight for step in form.steps if not isinstance(step, CNOTs) for weight in step.angles.weights]
    assert len(weights) == len(set(weights)) == 8 * 3 - 2
    assert (0, 0) not in weights  # phi of the first sublayer: a global phase
    assert (7, 2) not in weights  # omega of the last: commutes with Z
    assert form.fixed_steps == 3
    assert form.measures_last_layer


def test_normal_form_drops_rings_that_cancel() -> None:
    """At n = 2 both rings visit the pair twice; at n = 4 the second one does."""
    two = normal_form(ANSATZE.build("qiren", 2, 1))
    assert all(not step.pairs for step in two.steps if isinstance(step, Diagonal))
    four = [step.pairs for step in normal_form(ANSATZE.build("qiren", 4, 1)).steps if isinstance(step, Diagonal)]
    assert [len(pairs) for pairs in four] == [4, 0, 4]


def test_diagonals_and_permutations() -> None:
    assert cz_signs(((0, 1),), 2).tolist() == [1, 1, 1, -1]
    once = cnot_permutation(((0, 1), (1, 2)), 3)
    state = np.arange(8)[cnot_permutation(((0, 1),), 3)][cnot_permutation(((1, 2),), 3)]
    assert np.array_equal(np.arange(8)[once], state)


def test_cones_of_qiren() -> None:
    cones = find_cones(ANSATZE.build("qiren", 8, 1)).cones
    assert [cone.wires for cone in cones[:2]] == [(0, 1, 7), (0, 1, 2)]
    assert {cone.coefficients for cone in cones} == {27}
    assert find_cones(ANSATZE.build("ternary", 2, 2)).cones[0].degrees == (4, 4)
    with pytest.raises(TooLarge, match=r"8 wires and 2 spectral layers.*choose method=statevector"):
        find_cones(ANSATZE.build("qiren", 8, 2))


def test_cones_need_scales_with_a_common_unit() -> None:
    operations = (Rotations(0), Encoding("Z", (1.0,)), Rotations(1), Encoding("Z", (2**0.5,)), Rotations(2))
    circuit = Circuit("odd", 1, 2, 1, operations, (((0, "Z"),),))
    with pytest.raises(TooLarge, match="no common unit"):
        find_cones(circuit)


def test_reuploading_circuits_measure_each_wire_in_one_letter() -> None:
    assert not Circuit("two", 2, 1, 2, (), (((0, "Z"),), ((0, "X"),))).reuploading
    assert Circuit("one", 2, 1, 2, (), (((0, "Z"),), ((1, "X"),))).reuploading


def test_mistakes_in_options_of_an_ansatz_are_one_line() -> None:
    for options, message in (
        ({"ranges": (3, 1)}, "none a multiple of 3"),
        ({"ranges": (1,)}, "needs 2 distances"),
    ):
        with pytest.raises(ValueError, match=message):
            ANSATZE.build("qiren", 3, 1, **options)
