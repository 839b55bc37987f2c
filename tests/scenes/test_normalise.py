"""The world frame: up, centre, scale, and which views train."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qnerf.scenes import split_views
from qnerf.scenes.normalise import far_out, normalise, rigid, rotation_between


def random_rotation(random):
    q, r = np.linalg.qr(random.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def random_poses(seed, views=7):
    random = np.random.default_rng(seed)
    return np.stack([np.column_stack([random_rotation(random), random.normal(size=3) * 5 + 9]) for _ in range(views)])


@given(st.integers(0, 2**32 - 1))
def test_cameras_stand_upright_around_the_origin_within_one(seed):
    source = random_poses(seed)
    poses, transform = normalise(source)
    centres = poses[:, :, 3]
    np.testing.assert_allclose(centres.mean(0), 0, atol=1e-9)
    assert np.abs(centres).max() == pytest.approx(1, abs=1e-12)
    up = poses[:, :, 1].mean(0)
    np.testing.assert_allclose(up[:2], 0, atol=1e-9)
    assert up[2] > 0
    rotations = poses[:, :, :3]
    np.testing.assert_allclose(
        rotations.transpose(0, 2, 1) @ rotations, np.broadcast_to(np.eye(3), (7, 3, 3)), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1)
    # the reported similarity takes the source's world to this one
    np.testing.assert_allclose(source[:, :, 3] @ transform[:3, :3].T + transform[:3, 3], centres, atol=1e-9)
    scale = np.cbrt(np.linalg.det(transform[:3, :3]))
    np.testing.assert_allclose(transform[:3, :3] @ source[:, :, :3] / scale, rotations, atol=1e-9)


def test_cameras_at_one_point_have_no_scale():
    poses = random_poses(0)
    for at in (0.0, 1e-9, 4.0, 1e9):
        poses[:, :, 3] = at
        for centre in (True, False):
            with pytest.raises(ValueError, match="all cameras stand at the same point"):
                normalise(poses, centre=centre)


vectors = st.lists(st.floats(-10, 10), min_size=3, max_size=3).filter(lambda v: np.linalg.norm(v) > 0.1).map(np.array)


@given(vectors, vectors)
def test_rotation_between_takes_one_direction_to_the_other(a, b):
    turn = rotation_between(a, b)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(turn) == pytest.approx(1)
    np.testing.assert_allclose(turn @ a / np.linalg.norm(a), b / np.linalg.norm(b), atol=1e-4)


def test_rotation_between_opposite_directions():
    for axis in np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0, -0.8]]):
        turn = rotation_between(axis, -axis)
        np.testing.assert_allclose(turn @ axis, -axis, atol=1e-12)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(turn) == pytest.approx(1)


def test_rigid_makes_a_nearly_exact_rotation_exact_and_takes_out_a_common_scale():
    pose = np.eye(4)
    pose[:3] = random_poses(1)[0]
    for factor in (1 + 3e-4, 0.2517, 40.0):
        noisy = pose.copy()
        noisy[:3, :3] *= factor
        found, scale = rigid(noisy, "frame")
        np.testing.assert_allclose(found, pose[:3], atol=1e-12)
        assert scale == pytest.approx(factor)


def test_poses_that_are_not_rigid_are_refused_by_name():
    for change, message in (
        (lambda p: p * [1.01, 1, 1, 1], "at right angles and equally long"),
        (lambda p: p * [0, 0, 0, 1], "at right angles and equally long"),
        (lambda p: p * [[-1], [1], [1], [1]], "mirrors space"),
        (lambda p: p + np.where(np.eye(4)[0] > 0, np.nan, 0), "NaN"),
        (lambda p: p * 0, "last row"),
        (lambda p: np.where(p == 0, np.inf, p), "infinity"),
        (lambda p: p[:2], "4 x 4"),
        (lambda p: p[0], "4 x 4"),
        (lambda p: np.array(1.0), "4 x 4"),
    ):
        with pytest.raises(ValueError, match=message) as error:
            rigid(change(np.eye(4)), "frame 'a b.png'")
        assert str(error.value).startswith("frame 'a b.png'")


@given(st.integers(3, 500))
def test_nine_views_in_ten_train_and_the_rest_evaluate(views):
    train, held_out = split_views(views)
    assert sorted(train + held_out) == list(range(views))
    assert len(train) == min(math.ceil(0.9 * views), views - 1)
    assert train[0] == 0
    assert train[-1] == views - 1


@pytest.mark.parametrize("far", [[6], [0, 6], [3]])
def test_a_view_far_out_does_not_decide_the_scale(far):
    source = random_poses(3, views=12)
    inside, similarity = normalise(np.delete(source, far, axis=0))
    source[far, 0, 3] += 3e4
    poses, transform = normalise(source)
    np.testing.assert_allclose(transform, similarity, atol=1e-9)
    np.testing.assert_allclose(np.delete(poses, far, axis=0), inside, atol=1e-9)
    assert far_out(source[:, :, 3]).nonzero()[0].tolist() == far
    assert (far_out(source[:, :, 3])[far] > 1000).all()


def test_views_are_not_far_out_where_others_lie_between_or_there_are_few():
    spread = np.geomspace(1, 1e4, 30)[:, None] * [1.0, 0, 0]
    for centres in (spread, spread[[0, 1, 2, 29]], random_poses(0)[:, :, 3]):
        assert not far_out(centres).any()
