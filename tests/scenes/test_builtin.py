"""The built-in scenes: their shapes, their exact depth, their options, and the light that changes with the view."""

import dataclasses

import pytest
import torch

from qnerf.geometry.rays import RayTable, project
from qnerf.scenes import SCENES
from qnerf.training.image_metrics import VIEW_DEPENDENT


@pytest.mark.parametrize(("name", "width"), [("poster", 36), ("glossy", 64)])
def test_built_in_scenes_have_their_shapes_and_split(name, width):
    scene = SCENES.build(name, views=12)
    assert scene.images.shape == (12, 64, width, 3)
    assert scene.images.dtype == torch.uint8
    assert scene.depth.shape == (12, 64, width)
    assert scene.depth.dtype == torch.float32
    assert scene.cameras.poses.shape == (12, 3, 4)
    assert (len(scene.train), len(scene.eval)) == (11, 1)
    assert sorted(scene.names) == scene.names == [f"{view:02d}" for view in range(12)]
    assert float(scene.cameras.poses[:, :, 3].abs().max()) == pytest.approx(1)


def test_views_are_spread_over_the_path():
    scene, whole = SCENES.build("poster", views=4), SCENES.build("poster")
    assert torch.equal(scene.images, whole.images[[0, 75, 150, 225]])
    assert scene.fingerprint != whole.fingerprint


def points_of(scene, view):
    """The points (N, 3) that the pixels of a view show, row by row."""
    return RayTable(scene, dtype=torch.float64).view(view).along(scene.depth[view].reshape(-1, 1).double())[:, 0]


def seen_again(scene, view, other):
    """Pixels of a view that the other one shows, too: their number, row and column there, and its depth's error."""
    points = points_of(scene, view)
    pixels, _ = project(scene.cameras, torch.full((len(points),), other), points)
    column, row = pixels.long().unbind(-1)
    inside = (pixels >= 0).all(-1) & (column < scene.cameras.width) & (row < scene.cameras.height)
    expected = torch.linalg.vector_norm(points - scene.cameras.poses[other, :, 3], dim=-1)[inside]
    row, column = row[inside], column[inside]
    return inside.nonzero()[:, 0], row, column, (scene.depth[other][row, column] / expected - 1).abs()


@pytest.mark.parametrize(("name", "view", "other"), [("poster", 0, 1), ("glossy", 60, 39)])
def test_points_at_the_depth_of_a_view_are_at_the_depth_of_another(name, view, other):
    _, _, _, off = seen_again(SCENES.build(name), view, other)
    assert len(off) > 1500
    assert (off < 0.02).double().mean() > 0.85  # others lie at edges, or behind something


@pytest.mark.parametrize(("view", "other"), [(20, 41), (60, 39), (100, 113)])
def test_only_pixels_with_specular_light_change_with_the_view(view, other):
    """Of neighbouring views: the same points, shown by both."""
    scene = SCENES.build("glossy")
    pixel, row, column, off = seen_again(scene, view, other)
    pixel, row, column = (part[off < 0.01] for part in (pixel, row, column))
    change = (scene.images[view].flatten(0, 1)[pixel].int() - scene.images[other][row, column].int()).abs().amax(1)
    specular = torch.stack([scene.specular[view].flatten()[pixel], scene.specular[other][row, column]])
    assert change[(specular == 0).all(0)].median() <= 2
    assert change[(specular >= VIEW_DEPENDENT).all(0)].median() >= 12


def test_the_matte_table_has_no_specular_light():
    scene = SCENES.build("glossy", views=12)
    back = torch.linalg.inv(scene.transform)
    for view in range(12):
        height = points_of(scene, view) @ back[2, :3] + back[2, 3]
        aside = (height.abs() > 0.005).view(1, 64, 64).float()
        table = torch.nn.functional.max_pool2d(aside, 3, 1, 1)[0] == 0  # and all neighbours: no edge of anything else
        assert table.sum() > 500
        assert scene.specular[view][table].max() == 0


@pytest.mark.parametrize(("name", "most"), [("poster", 226), ("glossy", 120)])
def test_built_in_scenes_refuse_bad_options(name, most):
    for options, message in (
        ({"views": 2}, f"views must be between 3 and {most}"),
        ({"views": most + 1}, f"views must be between 3 and {most}"),
        (
            {"path": "somewhere"},
            f"scene={name} is built in and has no path, got 'somewhere'; for images use scene=nerf",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            SCENES.build(name, **options)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"images": lambda x: x[:1]}, r"images: expected uint8 \(6, 64, 36, 3\), got uint8 \(1, 64, 36, 3\)"),
        ({"images": lambda x: x.float()}, "images: expected uint8 .*, got float32"),
        ({"depth": lambda x: x[:, 1:]}, r"depth: expected float32 or float64 \(6, 64, 36\)"),
        ({"specular": lambda x: torch.ones(6, 64, 36)}, "specular: expected uint8 .*, got float32"),
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
