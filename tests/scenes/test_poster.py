"""The built-in scene: its shapes, its exact depth, its options."""

import pytest
import torch

from qnerf.geometry.rays import RayTable, project
from qnerf.scenes import SCENES


def test_shapes_and_split():
    scene = SCENES.build("poster", views=12)
    assert scene.images.shape == (12, 64, 36, 3)
    assert scene.images.dtype == torch.uint8
    assert scene.depth.shape == (12, 64, 36)
    assert scene.depth.dtype == torch.float32
    assert scene.cameras.poses.shape == (12, 3, 4)
    assert (len(scene.train), len(scene.eval)) == (11, 1)
    assert sorted(scene.names) == scene.names == [f"{view:02d}" for view in range(12)]
    assert float(scene.cameras.poses[:, :, 3].abs().max()) == pytest.approx(1)


def test_views_are_spread_over_the_path():
    scene, whole = SCENES.build("poster", views=4), SCENES.build("poster")
    assert torch.equal(scene.images, whole.images[[0, 75, 150, 225]])
    assert scene.fingerprint != whole.fingerprint


def test_points_at_the_depth_of_a_view_are_at_the_depth_of_the_next():
    scene = SCENES.build("poster")
    points = RayTable(scene, dtype=torch.float64).view(0).along(scene.depth[0].reshape(-1, 1).double())[:, 0]
    pixels, _ = project(scene.cameras, torch.ones(len(points), dtype=torch.int64), points)
    column, row = pixels.long().unbind(-1)
    inside = (pixels >= 0).all(-1) & (column < 36) & (row < 64)
    expected = torch.linalg.vector_norm(points - scene.cameras.poses[1, :, 3], dim=-1)[inside]
    off = (scene.depth[1][row[inside], column[inside]] / expected - 1).abs()
    assert inside.sum() > 1500
    assert (off < 0.02).double().mean() > 0.9  # others lie at edges, or behind something


def test_bad_options():
    for options, message in (
        ({"views": 2}, "views must be between 3 and 226"),
        ({"views": 227}, "views must be between 3 and 226"),
        ({"path": "somewhere"}, "built in and has no path, got 'somewhere'; for images use scene=nerfstudio"),
    ):
        with pytest.raises(ValueError, match=message):
            SCENES.build("poster", **options)
