"""How fine a grid the images ask for."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from qnerf.auto.detail import (
    WORTH,
    above,
    cells_per_world_unit,
    finest_frequency,
    focus_distance,
    world_units_along_the_cube,
)
from qnerf.geometry.contraction import CONTRACTIONS
from tests.helpers.worlds import ball, cameras, constant, floor, look_at, ring, scene


@pytest.mark.parametrize("detail", [2.0, 4.0, 8.0])
def test_the_finest_frequency_of_a_pattern_is_found(detail):
    """The camera is 1 above the floor, so that a cycle a world unit is 1/40 of a cycle a pixel."""
    found = finest_frequency(floor(detail=detail))
    assert detail / 40 < found < 2.2 * detail / 40 + 0.05


def test_images_without_detail_ask_for_nothing():
    for value, channels in ((0, 3), (255, 3), (77, 3), (0, 4), (200, 4)):
        assert finest_frequency(constant(value, channels=channels)) == 0
        assert cells_per_world_unit(constant(value, channels=channels)) == 0


def test_noise_asks_for_all_that_pixels_can_show():
    images = torch.randint(0, 256, (6, 24, 32, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    assert finest_frequency(dataclasses.replace(constant(0), images=images)) == 0.5


@given(st.lists(st.tuples(st.floats(0, 0.7), st.floats(0, 1e-3)), min_size=1, max_size=30))
def test_beyond_the_frequency_there_is_no_more_power_than_it_is_worth(pairs):
    radius, power = (np.array(column) for column in zip(*pairs, strict=True))
    found = above(radius, power)
    assert 0 <= found <= 0.5
    if found < 0.5:
        assert power[radius > found].sum() <= WORTH
    if found > 0:
        assert power[radius >= found].sum() >= WORTH


def test_the_focus_of_a_ring_is_its_middle():
    of = cameras(ring(9, radius=2.0, height=0.3))
    world = scene(torch.zeros(9, of.height, of.width, 3, dtype=torch.uint8), of)
    assert focus_distance(world) == pytest.approx(np.hypot(2.0, 0.3))
    assert focus_distance(ball()) == pytest.approx(np.hypot(1.0, 0.5))


def test_cameras_without_a_common_focus_are_taken_to_look_a_unit_away():
    outward = cameras(ring(6, outward=True))
    parallel = cameras(np.stack([look_at((x, 0, 0), np.array([x, 1.0, 0])) for x in (0.0, 0.3, 0.7)]))
    ahead = ring(9)[:, :, 3] * (1, 1, 0)
    beside = np.roll(ahead, 1, axis=1) * (-1, 1, 0)  # each axis passes the middle at five times its distance
    passing = cameras(np.stack([look_at(c, c + a) for a, c in zip(ahead, 0.3 * beside - 0.06 * ahead, strict=True)]))
    for of in (outward, parallel, passing):
        world = scene(torch.zeros(len(of), of.height, of.width, 3, dtype=torch.uint8), of)
        assert focus_distance(world) == 1.0


def test_a_contraction_squeezes_what_is_far_away():
    linf, box = CONTRACTIONS.build("linf"), CONTRACTIONS.build("box", half_extent=0.5)
    assert world_units_along_the_cube(linf, None) == pytest.approx(4)
    assert world_units_along_the_cube(linf, np.array([0.3, -0.9, 0.0])) == pytest.approx(4)
    far = np.array([0.0, 5.0, 0.0])  # across: x / 5 (2 - 1/5)
    assert world_units_along_the_cube(linf, far) == pytest.approx(4 * 5 / 1.8)
    assert world_units_along_the_cube(box, far) == pytest.approx(1)
