"""The visual hull: nothing of the object is ever taken away, and what some view sees through goes."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qnerf.geometry.contraction import CONTRACTIONS
from qnerf.geometry.hull import bounding_spheres, carve, sees_through, visual_hull
from qnerf.geometry.visibility import SpaceMask
from tests.helpers.worlds import BALL, ball, balls, bent, cameras, constant, contradicting, look_at, ring, scene

RESOLUTIONS = (5, 16, 40)


@pytest.fixture(scope="module")
def world():
    return ball()


def inside_of(centre, radius, count=4000):
    """Points (N, 3) of a ball, its surface among them."""
    random = np.random.default_rng(0)
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distances = radius * np.minimum(1.0, 1.5 * random.uniform(size=(count, 1)) ** (1 / 3))
    return torch.from_numpy(np.array(centre) + directions * distances)


@settings(max_examples=25)
@given(
    centre=st.tuples(*[st.floats(-0.5, 0.5)] * 3),
    radius=st.floats(0.2, 0.5),
    focal=st.floats(16, 60),
    resolution=st.integers(4, 16),
    name=st.sampled_from(CONTRACTIONS.names()),
)
def test_an_object_stays_wherever_it_is_and_even_where_it_leaves_the_images(centre, radius, focal, resolution, name):
    """Short focal lengths have spheres far off the axis; long ones have objects that the images cut off."""
    of = cameras(ring(5, radius=1.5), 40, 32, focal)
    world = scene(balls(of, (centre, radius)), of)
    contraction = CONTRACTIONS.build(name)
    left = carve(world, *bounding_spheres(contraction, resolution))
    mask = SpaceMask(left.view(resolution, resolution, resolution))
    assert bool(mask(contraction(inside_of(centre, radius, 500))).all())


def test_a_finer_grid_leaves_less(world):
    box = CONTRACTIONS.build("box")
    fractions = [visual_hull(box, world, resolution).double().mean() for resolution in RESOLUTIONS]
    assert fractions == sorted(fractions, reverse=True)
    assert fractions[-1] < 0.5 * fractions[0]
    assert fractions[-1] > 4 / 3 * np.pi * BALL**3 / 8


def test_the_spheres_hold_their_cells():
    for name in CONTRACTIONS.names():
        contraction = CONTRACTIONS.build(name)
        n = 12
        points, radius = bounding_spheres(contraction, n)
        random = torch.rand(40, n**3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        index = torch.arange(n**3)
        corners = torch.stack([index // (n * n), index // n % n, index % n], dim=-1)
        drawn = contraction.inverse((corners + random) / n)
        assert bool((torch.linalg.vector_norm(drawn - points, dim=-1).amax(0) <= 1.001 * radius).all())


def test_a_view_looks_through_nothing_that_it_does_not_wholly_see():
    of = cameras(look_at((0, -2.0, 0), np.zeros(3))[None].repeat(2, 0), 20, 20, 20.0)
    empty = scene(torch.zeros(2, 20, 20, 4, dtype=torch.uint8), of)
    points = torch.tensor([[0, 0, 0], [0, -1.9, 0], [0, -3, 0], [0.95, 0, 0], [0, 0, 0.95], [2, 0, 0]]).double()
    radius = torch.full((6,), 0.2, dtype=torch.float64)
    assert sees_through(empty, 0, points, radius).tolist() == [True, False, False, False, False, False]
    assert sees_through(empty, 0, points, radius / 10).tolist() == [True, True, False, True, True, False]


def test_a_view_that_is_solid_throughout_takes_nothing_away():
    opaque = constant(255, channels=4)
    assert bool(visual_hull(CONTRACTIONS.build("box"), opaque, 8).all())


def test_images_that_cannot_serve_are_one_line():
    for world, half, message in (
        (constant(100), 0.4, "visibility.alpha: the images of scene world have no alpha; use visibility.alpha=false"),
        (constant(0, channels=4), 0.2, "the silhouettes of scene world leave no space"),
        (contradicting(), 0.4, r"leave no space; use visibility\.alpha=false"),
        (bent(), 0.4, "lens distortion, which silhouettes do not support"),
    ):
        with pytest.raises(ValueError, match=message) as caught:
            visual_hull(CONTRACTIONS.build("box", half_extent=half), world, 24)
        assert "\n" not in str(caught.value)
