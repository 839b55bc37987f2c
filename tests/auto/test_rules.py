"""Each rule on scenes that are made to be decided either way."""

import dataclasses
import math

import pytest
import torch

from qnerf.auto.rules import EMBEDDING, FINEST, RULES, Measured
from tests.helpers.configs import composed
from tests.helpers.worlds import ball, brightened, cameras, constant, floor, ring, scene, turned

BALL, FLOOR = ball(focal=45.0, radius=0.2), floor()
OUTWARD = scene(constant(9).images, cameras(ring(6, outward=True)))
AUTO = composed("needs=auto")


def decided(option: str, world, config=AUTO):
    return RULES[option](Measured(world), config)


def hashed(**table) -> dict:
    """Of a contraction that is decided already, and these hash tables."""
    return AUTO | {
        "contraction": {"name": "linf"},
        "encoder": {"name": "hash", "min_resolution": 16, "features": 1, **table},
    }


def test_rules_find_what_a_scene_needs():
    for option, world, value in (
        ("contraction.name", BALL, "box"),
        ("contraction.name", FLOOR, "linf"),
        ("contraction.name", constant(255, channels=4), "linf"),
        ("render.far", FLOOR, 1000.0),
        ("render.background", BALL, "white"),
        ("render.background", FLOOR, "last_sample"),
        ("visibility.alpha", BALL, True),
        ("visibility.alpha", FLOOR, False),
        ("train.error_rays", BALL, 0.75),
        ("train.error_rays", FLOOR, 0.0),
        ("visibility.cameras", BALL, 4),
        ("visibility.cameras", OUTWARD, 0),
        ("appearance", FLOOR, 0),
        ("appearance", brightened(FLOOR, 0.15), EMBEDDING),
        ("appearance", constant(0), 0),
        ("cameras.name", FLOOR, "fixed"),
        ("cameras.name", constant(0), "fixed"),
    ):
        decision = decided(option, world)
        assert decision.value == value
        assert type(decision.value) is type(value)
        assert all(type(number) is float for number in decision.because.values())


def test_poses_are_refined_where_they_are_off(poster):
    for world, value in ((poster, "fixed"), (turned(poster, 1.0), "so3xr3")):
        decision = decided("cameras.name", world)
        assert decision.value == value
        assert decision.because["pairs"] >= 4


def test_a_box_has_the_half_extent_that_was_measured_and_bounds_around_it():
    half = decided("contraction.half_extent", BALL).value
    assert decided("contraction.name", BALL).because == {"half_extent": half}
    near, far = (decided(f"render.{bound}", BALL).value for bound in ("near", "far"))
    away = math.hypot(1, 0.5)
    assert 0 < near < away - 0.2 < away + 0.2 < far < 2 * away


def test_a_half_extent_that_nothing_bounds_is_one_line():
    with pytest.raises(ValueError, match=r"contraction\.half_extent=auto: silhouettes bound no object here") as caught:
        decided("contraction.half_extent", FLOOR)
    assert "\n" not in str(caught.value)


def test_near_is_where_enough_cameras_begin_to_see_or_the_usual():
    assert 0.1 < decided("render.near", FLOOR).value < 0.9
    assert decided("render.near", OUTWARD).value == 0.05


def test_sharp_images_ask_for_a_finer_grid_of_more_levels():
    resolutions, levels = [], []
    for world in (constant(50), floor(detail=2.0), floor(detail=8.0)):
        resolutions.append(decided("encoder.max_resolution", world, hashed()).value)
        levels.append(decided("encoder.levels", world, hashed(max_resolution=resolutions[-1])).value)
    assert resolutions[0] == 16
    assert resolutions == sorted(set(resolutions))
    assert levels[0] == 1
    assert levels == sorted(set(levels))
    assert all(resolution % 16 == 0 for resolution in resolutions)


def test_levels_grow_by_half_at_most():
    for least, most in ((16, 16), (16, 17), (16, 24), (16, 25), (16, 2048), (5, 1000), (64, 32)):
        count = decided("encoder.levels", FLOOR, hashed(min_resolution=least, max_resolution=most)).value
        assert count >= 1
        assert least * 1.5 ** (count - 1) >= most * (1 - 1e-9)
        assert count == 1 or least * 1.5 ** (count - 2) < most


def test_the_finest_grid_is_bounded():
    noise = torch.randint(0, 256, (4, 16, 16, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    far = cameras(ring(4), 16, 16, 1e5)
    assert decided("encoder.max_resolution", scene(noise, far), hashed()).value == FINEST
    assert decided("encoder.max_resolution", constant(0), hashed(min_resolution=40)).value == 40


def test_tables_hold_as_many_numbers_as_there_are_colour_values_in_training():
    for pixels, steps in ((1, 3000), (30, 3000), (1000, 10**6), (1000, 300)):
        world = constant(0, views=11, width=pixels, height=pixels)
        config = hashed(levels=6, features=2) | {"train": AUTO["train"] | {"steps": steps, "rays": 256}}
        size = decided("encoder.log2_table_size", world, config).value
        numbers, observed, drawn = 6 * 2 * 2**size, 3 * 10 * pixels**2, 3 * 256 * steps
        values = min(observed, drawn)
        assert 10 <= size <= 19
        assert size in (10, 19) or values / 2 < numbers <= values


def test_sixteen_times_the_pixels_take_twice_the_steps():
    for pixels, steps in ((1000, 3000), (100_000, 3000), (1_600_000, 6000), (2e12, 30_000)):
        measured = Measured(FLOOR)
        measured.observed = 3 * int(pixels)
        assert RULES["train.steps"](measured, AUTO).value == steps


def test_numbers_by_hand_that_a_rule_cannot_use_are_one_line():
    for option, table, message in (
        ("encoder.max_resolution", {"min_resolution": "auto"}, "encoder.min_resolution must be .* got 'auto'"),
        ("encoder.levels", {"min_resolution": 0, "max_resolution": 64}, "encoder.min_resolution must be .* got 0"),
        ("encoder.log2_table_size", {"levels": 3, "features": 1.5}, "encoder.features must be .* got 1.5"),
    ):
        with pytest.raises(ValueError, match=message) as caught:
            decided(option, FLOOR, hashed(**table))
        assert "\n" not in str(caught.value)


def test_a_positional_encoding_reaches_the_images_finest_detail():
    encoder = {"encoder": {"name": "pe", "bands": "auto", "max_exponent": "auto"}}
    exponents = []
    for world in (constant(50), floor(detail=2.0), floor(detail=8.0)):
        exponents.append(decided("encoder.max_exponent", world, hashed() | encoder).value)
    assert exponents == sorted(exponents)
    assert exponents[0] == 1 < exponents[-1]
    set_ = {"encoder": {"name": "pe", "bands": "auto", "max_exponent": 6.0}}
    assert decided("encoder.bands", FLOOR, hashed() | set_).value == 8


def test_rules_measure_once_and_when_asked(monkeypatch):
    without = dataclasses.replace(FLOOR)
    object.__setattr__(without, "images", None)  # whoever looks at them fails
    measured = Measured(without)
    assert RULES["shading.name"](measured, AUTO).value == "merge"
    calls = []
    monkeypatch.setattr("qnerf.auto.exposure.exposure_spread", lambda scene: calls.append(1) or 0.2)
    for _ in range(2):
        assert RULES["appearance"](measured, AUTO).value == EMBEDDING
    assert calls == [1]
