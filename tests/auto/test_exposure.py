"""Exposure that differs between views is told from exposure that does not."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qnerf.auto.exposure import best_shift, exposure_spread, gain, warning
from qnerf.auto.rules import EXPOSURE
from tests.helpers.worlds import ball, brightened, constant, floor, texture


@pytest.fixture(scope="module")
def world():
    return floor()


def test_exposure_that_varies_by_fifteen_percent_is_above_the_limit(world):
    assert exposure_spread(world) < 0.2 * EXPOSURE
    for seed in range(3):
        assert exposure_spread(brightened(world, 0.15, seed)) > EXPOSURE


def test_a_spread_that_harms_is_one_line(world, poster):
    assert warning(poster) is None
    assert warning(constant(200)) is None
    told = warning(brightened(world, 0.3))
    assert "from one photograph to another" in told
    assert "\n" not in told


def test_exposure_spread_is_measured(world):
    """Over neighbours in a row, whose factors are independent."""
    found = np.mean([exposure_spread(brightened(world, 0.08, seed)) for seed in range(6)])
    assert found == pytest.approx(0.08, rel=0.25)


def pattern(rows: int = 0, columns: int = 0, factor: float = 1.0) -> np.ndarray:
    y, x = np.mgrid[rows : rows + 40, columns : columns + 40] / 40
    return factor * texture(x, y, 4.0)


@settings(max_examples=15)
@given(rows=st.integers(-4, 4), columns=st.integers(-4, 4), logarithm=st.floats(-0.15, 0.15))
def test_the_gain_of_a_shifted_and_brightened_view(rows, columns, logarithm):
    a, b = pattern(), pattern(2 * rows, 2 * columns, np.exp(logarithm))
    assert best_shift(a, b)[0] == (2 * rows, 2 * columns)
    assert gain(a, b) == pytest.approx(-logarithm, abs=1e-6)


def test_views_of_other_things_say_nothing():
    random = np.random.default_rng(0)
    assert np.isnan(gain(random.uniform(size=(40, 40)), random.uniform(size=(40, 40))))


def test_too_few_pairs_cannot_tell(world):
    assert np.isnan(exposure_spread(dataclasses.replace(world, train=[0, 1])))
    assert np.isnan(exposure_spread(ball()))


def test_transparent_pixels_are_left_out(world):
    alpha = torch.full_like(world.images[..., :1], 255)
    alpha[:, :12] = 0
    cut = torch.cat([world.images, alpha], dim=-1)
    cut[:, :12, :, :3] = 200
    assert exposure_spread(dataclasses.replace(world, images=cut)) < 0.2 * EXPOSURE
    assert exposure_spread(brightened(dataclasses.replace(world, images=world.images), 0.15)) > EXPOSURE
