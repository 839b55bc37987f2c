"""When a training stops: the plateau's logic."""

import math

from hypothesis import given
from hypothesis import strategies as st

from qnerf.training.stopping import Plateau

psnrs = st.lists(st.floats(0, 50), max_size=30)


def fed(values, patience=3, least=0.1, every=10) -> Plateau:
    plateau = Plateau(every, patience, least)
    for value in values:
        plateau.add(value)
    return plateau


@given(psnrs, st.integers(1, 5), st.floats(0, 2))
def test_it_stops_after_so_many_checks_without_a_gain(values, patience, least):
    plateau = Plateau(10, patience, least)
    best, since = -math.inf, 0
    for value in values:
        assert plateau.reached == (since >= patience)
        plateau.add(value)
        gained = value >= best + least
        best, since = (value, 0) if gained else (best, since + 1)
    assert plateau.reached == (since >= patience)
    assert plateau.best <= max(values, default=-math.inf)


def test_a_psnr_that_is_no_number_is_no_gain():
    assert fed([20.0, math.nan, math.nan, math.nan]).reached


@given(psnrs)
def test_off_it_is_never_due_and_never_reached(values):
    plateau = fed(values, every=0, patience=1)
    assert not plateau.reached
    assert not any(plateau.due(step) for step in range(100))


@given(psnrs, psnrs)
def test_it_goes_on_from_its_state(before, after):
    whole, parts = fed(before), Plateau(10, 3, 0.1)
    parts.load(whole.state())
    for value in after:
        whole.add(value)
        parts.add(value)
    assert parts == whole
