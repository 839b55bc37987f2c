import math

import numpy as np
import pytest
import torch

from qnerf.geometry.camera_paths import PATHS, Camera, focal_as, focus, look_at
from qnerf.geometry.rays import camera_rays
from qnerf.scenes.base import Cameras

UP = np.array([0.0, 0, 1])
TARGET = np.array([0.3, -0.2, 0.1])


def ring(count=24, arc=2 * np.pi):
    """Cameras around `TARGET`, at distance 2 and height 0.5."""
    angle = np.arange(count) / count * arc
    centres = TARGET + np.stack([2 * np.cos(angle), 2 * np.sin(angle), np.full(count, 0.5)], axis=1)
    return np.stack([look_at(centre, TARGET, UP) for centre in centres])


def forward(count=20):
    """Cameras side by side that all look along +y."""
    places = np.random.default_rng(0).uniform(-1, 1, (count, 3)) * [1, 0.1, 0.5]
    return np.stack([look_at(place, place + np.array([0.0, 1, 0]), UP) for place in places])


def test_every_pose_of_a_path_is_rigid():
    for name in PATHS:
        for poses in (ring(), ring(7, 1.0), forward()):
            if name == "orbit" and focus(poses) is None:
                with pytest.raises(ValueError, match="no common point"):
                    PATHS[name](poses, 9)
                return
            path = PATHS[name](poses, 9)
            assert path.shape == (9, 3, 4)
            rotations = path[:, :, :3]
            np.testing.assert_allclose(
                rotations.transpose(0, 2, 1) @ rotations, np.broadcast_to(np.eye(3), (9, 3, 3)), atol=1e-9
            )
            np.testing.assert_allclose(np.linalg.det(rotations), 1)


def test_an_orbit_goes_all_around_where_cameras_are_and_back_where_they_end():
    for poses, low, high in ((ring(), 5.5, 6.3), (ring(7, 1.0), 0.7, 0.9)):
        offset = PATHS["orbit"](poses, 60)[:, :, 3] - TARGET
        np.testing.assert_allclose(np.hypot(offset[:, 0], offset[:, 1]), 2, atol=1e-6)
        np.testing.assert_allclose(offset[:, 2], 0.5, atol=1e-6)
        angles = np.unwrap(np.arctan2(offset[:, 1], offset[:, 0]))
        assert low < np.ptp(angles) < high


def test_an_orbit_is_far_away_where_the_cameras_are():
    near, far = ring(20, math.pi), ring(20, math.pi)
    far[:, :, 3] = TARGET + 3 * (far[:, :, 3] - TARGET)
    far[:, :2] *= -1  # half a turn about the target's axis
    far[:, :2, 3] += 2 * TARGET[:2]
    offset = PATHS["orbit"](np.concatenate([near, far]), 80)[:, :, 3] - TARGET
    bearing, away = np.arctan2(offset[:, 1], offset[:, 0]), np.hypot(offset[:, 0], offset[:, 1])
    for middle, radius in ((math.pi / 2, 2), (-math.pi / 2, 6)):
        one = np.abs(bearing - middle).argmin()
        np.testing.assert_allclose((away[one], offset[one, 2]), (radius, radius / 4), atol=0.05)
    assert np.abs(np.diff(away)).max() < 0.6, "no jumps"


def test_a_path_through_one_camera_is_refused():
    with pytest.raises(ValueError, match="interpolate: expected at least two training cameras, got one"):
        PATHS["interpolate"](ring(1, 1.0), 10)
    assert PATHS["spiral"](ring(1, 1.0), 10).shape == (10, 3, 4)


def test_a_path_passes_through_the_cameras_in_the_shorter_order():
    poses = ring(8, 3.0)
    shuffled = poses[[0, 4, 2, 6, 1, 5, 3, 7]]
    path = PATHS["interpolate"](shuffled, 701)
    nearest = np.linalg.norm(path[:, None, :, 3] - poses[None, :, :, 3], axis=-1).argmin(0)
    np.testing.assert_allclose(path[nearest], poses, atol=0.02)
    assert (np.diff(nearest) > 0).all()


def test_a_spiral_of_forward_facing_cameras_stays_among_them():
    path = PATHS["spiral"](forward(), 30)
    assert np.abs(path[:, :, 3]).max() < 1.3
    assert (path[:, 1, 2] < -0.9).all()  # it looks along +y


def test_pinhole_rays_are_those_of_the_scene_s_cameras():
    pose = look_at(np.array([1.0, 2, 0.5]), TARGET, UP)
    one = torch.ones(1, dtype=torch.float64)
    cameras = Cameras(
        torch.from_numpy(pose)[None], 5 * one, 5 * one, 3 * one, 2 * one, torch.zeros(1, 4).double(), 6, 4
    )
    pixels = torch.stack(torch.meshgrid(torch.arange(6), torch.arange(4), indexing="xy"), -1).reshape(-1, 2) + 0.5
    views = torch.zeros(len(pixels), dtype=torch.int64)
    theirs = camera_rays(cameras, views, pixels, 0.1, 3.0)
    mine = Camera(pose, 5.0, 6, 4).rays(slice(0, 24), 0.1, 3.0)
    for name in ("origins", "directions", "near", "far"):
        torch.testing.assert_close(getattr(mine, name), getattr(theirs, name))
    assert torch.equal(Camera(pose, 5.0, 6, 4).rays(slice(7, 11), 0.1, 3.0).directions, mine.directions[7:11])
    assert np.array_equal(look_at([1, 2, 0.5], TARGET.tolist(), UP.tolist()), pose)
    for wrong in ((np.eye(4), 5.0, 6, 4), (pose, 5.0, 0, 4)):
        with pytest.raises(ValueError, match="expected"):
            Camera(*wrong)
    assert focal_as(cameras, 0, 12, 8) == pytest.approx(10)
    assert focal_as(cameras, 0, 4, 6) == pytest.approx(5)
