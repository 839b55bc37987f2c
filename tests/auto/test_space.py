"""Whether a scene is bounded, and where its rays are seen by enough cameras."""

import math

import numpy as np
import pytest
import torch

from qnerf.auto.space import MARGIN, Followed, box_half_extent, hull_bounds
from qnerf.geometry.visibility import count_cameras
from tests.helpers.worlds import BALL, ball, balls, bent, cameras, constant, contradicting, floor, look_at, ring, scene


@pytest.mark.parametrize("radius", [0.2, 0.4])
def test_the_box_holds_the_object_and_little_more(radius):
    of = cameras(ring(16), 64, 64, 45.0)
    half = box_half_extent(scene(balls(of, ((0, 0, 0), radius)), of))
    assert radius <= half < 2.2 * radius + 0.15


def test_box_needs_silhouettes_that_bound_an_object():
    for world in (floor(), constant(255, channels=4), constant(0, channels=4), contradicting(), bent()):
        assert box_half_extent(world) is None


def test_cameras_that_look_outward_see_no_bounded_object():
    of = cameras(ring(6, outward=True))
    spheres = [((3 * math.cos(a), 3 * math.sin(a), 1.5), 0.5) for a in 2 * np.pi * np.arange(6) / 6]
    assert box_half_extent(scene(balls(of, *spheres), of)) is None


def test_bounds_of_a_box_have_every_ray_pass_all_of_it():
    world = ball()
    near, far = hull_bounds(world, 0.5)
    away = math.hypot(1.0, 0.5)
    assert (near, far) == pytest.approx((0.9 * (away - 0.5 * 3**0.5), 1.1 * (away + 0.5 * 3**0.5)))
    assert hull_bounds(world, 2.0)[0] == 0.0
    assert near < away - BALL < away + BALL < far


def test_rays_are_followed_to_where_enough_cameras_see():
    world = floor()
    followed = Followed(world)
    least = followed.cameras()
    assert least == 3
    assert followed.coverage(4) <= followed.coverage(3) <= followed.coverage(2) <= 1
    near = followed.near(least)
    for view in world.train[:4]:
        pose = world.cameras.poses[view]
        before = pose[:, 3] - pose[:, 2] * torch.linspace(0.01, near, 20).double()[:, None]
        assert bool((count_cameras(before, world.cameras, world.train) < least).all())
    first = followed.distances[(followed.counts >= least).any(0)][0]
    assert near == pytest.approx(float(first) * (1 - MARGIN))


def test_near_is_not_set_by_one_place_seen_from_the_start():
    """Cameras side by side that look the same way see the same from very near on."""
    of = cameras(np.stack([look_at((1e-4 * view, 0, 0), np.array([1e-4 * view, 1.0, 0])) for view in range(5)]))
    assert Followed(scene(constant(9, views=5).images, of)).near(2) is None
