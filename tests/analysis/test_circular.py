import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from qnerf.analysis.circular import mean_direction, turn, wasserstein
from scipy.stats import wasserstein_distance

HUES = st.lists(st.integers(0, 359), min_size=1, max_size=40)


def turns(degrees):
    return np.array(degrees) / 360


@given(HUES, HUES, st.integers(0, 359))
def test_nothing_depends_on_where_the_circle_is_cut(first, second, rotation):
    one, other = np.array(first), np.array(second)
    rotated = (turns((one + rotation) % 360), turns((other + rotation) % 360))
    assert wasserstein(*rotated) == pytest.approx(wasserstein(turns(one), turns(other)), abs=1e-12)


@given(HUES, HUES)
def test_the_statistics_are_those_of_their_definitions(first, second):
    one, other = turns(first), turns(second)
    # The least over all places to cut the circle open, by brute force: one of the angles is always among them.
    cuts = [wasserstein_distance((one - cut) % 1, (other - cut) % 1) for cut in np.concatenate([one, other])]
    assert wasserstein(one, other) <= min(cuts) + 1e-12
    assert wasserstein(one, other) == pytest.approx(wasserstein(other, one))


def test_an_arc_is_the_shorter_way_round():
    assert wasserstein(np.array([0.98]), np.array([0.02])) == pytest.approx(0.04)
    assert wasserstein(np.array([0.0, 0.0]), np.array([0.0, 0.5])) == pytest.approx(0.25)
    assert turn(0.9, 0.1) == pytest.approx(0.2)
    assert turn(0.1, 0.9) == pytest.approx(-0.2)


def test_the_mean_of_two_reds_is_red():
    assert turn(0, mean_direction(np.array([0.95, 0.05]))) == pytest.approx(0, abs=1e-12)
    assert mean_direction(np.array([0.2, 0.3])) == pytest.approx(0.25)


def test_no_angle_gives_nan():
    assert np.isnan([wasserstein(np.ones(3), np.empty(0)), mean_direction(np.empty(0))]).all()
