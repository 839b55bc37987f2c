"""The built-in scene: its shapes, its exact depth, its options."""

import dataclasses

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


def test_poster_refuses_bad_options():
    for options, message in (
        ({"views": 2}, "views must be between 3 and 226"),
        ({"views": 227}, "views must be between 3 and 226"),
        ({"path": "somewhere"}, "built in and has no path, got 'somewhere'; for images use scene=nerfstudio"),
    ):
        with pytest.raises(ValueError, match=message):
            SCENES.build("poster", **options)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"images": lambda x: x[:1]}, r"images: expected uint8 \(6, 64, 36, 3\), got uint8 \(1, 64, 36, 3\)"),
        ({"images": lambda x: x.float()}, "images: expected uint8 .*, got float32"),
        ({"depth": lambda x: x[:, 1:]}, r"depth: expected float32 or float64 \(6, 64, 36\)"),
        ({"mask": lambda x: torch.ones(6, 64)}, r"mask: expected bool \(6, 64, 36\), got float32 \(6, 64\)"),
        ({"names": lambda x: x[1:]}, "expected a name for each of 6 views, got 5"),
        ({"train": lambda x: [0, 9]}, r"train: expected indices of views, 0 to 5, got \[0, 9\]"),
    ],
)
def test_a_scene_that_does_not_fit_its_cameras_is_refused_when_it_is_made(change, message):
    scene = SCENES.build("poster", views=6)
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(scene, **{name: make(getattr(scene, name)) for name, make in change.items()})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"poses": lambda x: x.float()}, r"Cameras.poses: expected float64 \(V, 3, 4\), got float32"),
        ({"poses": lambda x: x[:, :, :3]}, r"got float64 \(6, 3, 3\)"),
        ({"poses": lambda x: x * torch.nan}, "Cameras.poses: expected finite numbers"),
        ({"fx": lambda x: x[:1]}, r"Cameras.fx: expected float64 \(6\), got float64 \(1,\)"),
        ({"distortion": lambda x: x[:, :2]}, r"Cameras.distortion: expected float64 \(6, 4\)"),
    ],
)
def test_cameras_are_looked_at_when_they_are_made(change, message):
    cameras = SCENES.build("poster", views=6).cameras
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(cameras, **{name: make(getattr(cameras, name)) for name, make in change.items()})
