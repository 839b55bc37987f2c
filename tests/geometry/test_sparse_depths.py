"""The training pixels that show sparse points of a reconstruction."""

import dataclasses

import pytest
import torch

from qnerf.geometry.rays import RayTable
from qnerf.geometry.sparse_depths import SparseDepths
from tests.helpers import worlds

LAST = 11  # the view that is held out


@pytest.fixture(params=[False, True], ids=["plain", "masked"])
def ball(request):
    """A ball and points on the side of it that each view sees, one of them outside of the image."""
    scene = worlds.ball()
    sees = torch.arange(len(scene.cameras)).repeat(4)
    ahead = scene.cameras.poses[sees, :, 3] * torch.tensor([0.5, 0.6, 0.7, -3.0]).repeat_interleave(12)[:, None]
    ahead[36:] += torch.tensor([0, 0, 9.0])
    mask = torch.rand(scene.images.shape[:3], generator=torch.Generator().manual_seed(0)) < 0.5
    points = torch.cat([sees[:, None], ahead], 1)
    return dataclasses.replace(scene, points=points, mask=mask if request.param else None)


def test_rays_of_the_drawn_pixels_pass_their_points_at_the_drawn_distance(ball):
    table = RayTable(ball, dtype=torch.float64, validation_stride=5)
    numbers, distances = SparseDepths(ball, 5).draw(200, torch.Generator().manual_seed(0))
    assert ((numbers + 1) % 5 != 0).all()
    rays, _ = table.batch(numbers)
    assert LAST not in rays.cameras
    ends = rays.origins + distances[:, None] * rays.directions
    own = [ball.points[ball.points[:, 0] == view, 1:] for view in rays.cameras.tolist()]
    gaps = torch.stack([(points - end).norm(dim=1).min() for points, end in zip(own, ends, strict=True)])
    assert gaps.max() < 0.01  # half a pixel
    assert len(distances.unique()) > 2


def test_points_that_no_training_view_sees_are_refused(ball):
    unseen = dataclasses.replace(ball, points=ball.points[ball.points[:, 0] == LAST])
    with pytest.raises(ValueError, match="none of the scene's 4 sparse points is on a training pixel"):
        SparseDepths(unseen)
