"""Which views are compared with which."""

import dataclasses

import numpy as np
import pytest
import torch

from qnerf.auto.views import grey, neighbours, subset
from tests.helpers.worlds import ball, cameras, look_at, ring, scene


def empty(poses, **options):
    of = cameras(poses, 4, 4)
    return scene(torch.zeros(len(poses), 4, 4, 3, dtype=torch.uint8), of, **options)


def test_each_view_on_a_ring_is_paired_with_the_next():
    world = empty(ring(25))
    pairs = neighbours(world)
    assert all(b - a == 1 for a, b in pairs)
    assert {view for pair in pairs for view in pair} == set(range(24))


def test_only_training_views_are_paired():
    assert neighbours(empty(ring(25), train=[3, 4, 9], eval=[5])) == [(3, 4)]


def test_views_that_look_elsewhere_are_strangers_however_near():
    poses = np.stack([look_at((0, 0.01 * view, 0), np.array(target)) for view, target in enumerate(
        [(1.0, 0, 0), (0, 5.0, 0), (1.0, 0.1, 0)]
    )])  # fmt: skip
    assert neighbours(empty(poses, train=[0, 1, 2])) == [(0, 2)]
    assert neighbours(empty(poses[:2], train=[0, 1])) == []
    assert neighbours(empty(poses[:2], train=[0])) == []


def test_grey_is_the_mean_of_the_channels_and_nan_where_nothing_is():
    world = ball()
    values = grey(world, 0)
    solid = world.images[0, ..., 3].numpy() > 0
    assert np.isnan(values[~solid]).all()
    np.testing.assert_allclose(values[solid], 128 / 255)
    opaque = dataclasses.replace(world, images=world.images[..., :3].clone())
    opaque.images[0, 0, 0] = torch.tensor([0, 51, 255])
    assert grey(opaque, 0)[0, 0] == pytest.approx(0.4)


@pytest.mark.parametrize(("items", "most", "chosen"), [(3, 5, [0, 1, 2]), (10, 4, [0, 3, 6, 9]), (0, 2, [])])
def test_a_subset_is_evenly_spread(items, most, chosen):
    assert subset([(index, index) for index in range(items)], most) == [(index, index) for index in chosen]
