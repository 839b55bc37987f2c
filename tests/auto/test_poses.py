"""Poses that are off are told from poses that are not."""

import dataclasses
import re

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from qnerf.auto import poses
from qnerf.auto.poses import Epipolar, distances, epipolar_error, fundamental, matched, warning
from qnerf.geometry.rays import project
from qnerf.scenes.normalise import normalise
from tests.helpers.worlds import ball, constant, floor, turned

FLOOR = floor(views=3)


def test_warnings_name_what_is_wrong_and_following_them_ends_them(poster):
    assert warning(poster) is None
    assert "do not fit the images" in str(warning(turned(poster, 10.0)))
    of, flip, turn = poster.cameras, np.diag([1.0, -1, -1, 1]), np.eye(4)
    turn[:3, :3], turn[:3, 3] = Rotation.from_euler("xyz", [1, 2, 3]).as_matrix(), (5, -2, 9)
    source = turn @ np.stack([np.vstack([pose, [0, 0, 0, 1]]) for pose in of.poses.numpy()])
    colmap = np.linalg.inv(source @ flip)

    def read(poses):
        """The scene as a reader gives it of a file with these poses."""
        normal, similarity = normalise(poses[:, :3])
        cameras = dataclasses.replace(of, poses=torch.from_numpy(normal))
        return dataclasses.replace(poster, cameras=cameras, transform=torch.from_numpy(similarity))

    def reordered(poses, by):
        quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        changed = poses.copy()
        changed[:, :3, :3] = Rotation.from_quat(np.roll(quaternions, by, axis=1)).as_matrix()
        return changed

    def of_colmap(poses):
        return np.linalg.inv(poses) @ flip

    for wrong, text, cured in (
        (source @ flip, "OpenCV's axes", lambda poses: poses @ flip),
        (np.linalg.inv(source), "from the world to the camera", np.linalg.inv),
        (np.linalg.inv(source @ flip), "inverted", lambda poses: np.linalg.inv(poses) @ flip),
        (of_colmap(np.linalg.inv(colmap)), "inverted", lambda poses: of_colmap(poses @ flip)),
        (of_colmap(reordered(colmap, -1)), "qx qy qz qw", lambda _: of_colmap(reordered(reordered(colmap, -1), 1))),
    ):
        assert text in str(warning(read(wrong)))
        assert warning(read(cured(wrong))) is None
    for wrong, text in (
        ({"cx": 0 * of.cx, "cy": 0 * of.cy}, "the principal point seems to be wrong"),
        ({"fx": 2.1 * of.fx, "fy": 2.1 * of.fy}, "the focal length seems to be wrong (about 0.5 times fl_x would fit"),
    ):
        changed = dataclasses.replace(of, **wrong)
        assert text in str(warning(dataclasses.replace(poster, cameras=changed)))
        if found := re.search(r"about ([\d.]+) times", text):
            factor = float(found[1])
            cured = dataclasses.replace(changed, fx=factor * changed.fx, fy=factor * changed.fy)
            assert warning(dataclasses.replace(poster, cameras=cured)) is None


@pytest.mark.parametrize(("left", "advised"), [(0.3, True), (0.9, True), (5.7, False)])
def test_advice_is_given_only_where_it_leaves_less_than_a_pixel(monkeypatch, left, advised):
    found = Epipolar(given=19.0, best=0.14, pairs=8, others={poses.BOTH: left, poses.CENTRE: 18.0})
    monkeypatch.setattr(poses, "epipolar_error", lambda scene: found)
    told = str(warning(FLOOR))
    assert ("the poses seem to be inverted" in told) is advised
    assert ("the poses do not fit the images" in told) is not advised


@given(seed=st.integers(0, 2**20))
def test_points_seen_twice_lie_on_each_others_epipolar_lines(seed):
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(10, 3, dtype=torch.float64, generator=generator) - 0.5
    world = turned(FLOOR, 20.0, seed)
    seen = [project(world.cameras, torch.full((10,), view), points) for view in (0, 2)]
    if bool((torch.stack([depth for _, depth in seen]) > 0.1).all()):
        pixels = torch.stack([where for where, _ in seen], dim=1).numpy()
        assert distances(fundamental(world.cameras, 0, 2), pixels).max() < 1e-6


def test_features_lie_where_both_images_have_them():
    world = floor(views=12, detail=6.0)
    points = matched(*(world.images[view, ..., 0].numpy() / 255 for view in (5, 6)))
    assert len(points) > 20
    moved = points[:, 1] - points[:, 0]
    shift = -40 * 1.2 / 11  # pixels: focal length x distance between cameras 1 above the floor
    assert np.median(np.abs(np.abs(moved).max(1) - abs(shift))) < 0.3


@pytest.mark.parametrize("world", [constant(0), constant(255), ball()], ids=["black", "white", "outlines"])
def test_images_without_features_cannot_tell(world):
    """Nor do the outlines of a ball, which are another curve on it in each view."""
    error = epipolar_error(world)
    assert np.isnan([error.given, error.best]).all()
    assert error.pairs == 0


def test_the_smallest_images_are_no_error():
    for width, height in ((1, 1), (3, 2), (8, 6)):
        noise = torch.Generator().manual_seed(0)
        images = torch.randint(0, 256, (6, height, width, 3), dtype=torch.uint8, generator=noise)
        world = constant(0, width=width, height=height)
        assert epipolar_error(dataclasses.replace(world, images=images)).pairs == 0
        assert matched(*(image.double().mean(-1).numpy() / 255 for image in images[:2])).shape == (0, 2, 2)
