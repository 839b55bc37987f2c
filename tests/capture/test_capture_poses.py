"""`benchmarks.capture_poses`: errors are those that remain after a similarity."""

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.capture_poses import errors

RANDOM = np.random.default_rng(0)
TRUE = np.concatenate([Rotation.random(9, random_state=0).as_matrix(), RANDOM.normal(size=(9, 3, 1))], axis=2)


def moved(poses: np.ndarray) -> np.ndarray:
    """The poses in a world that is turned, scaled and shifted."""
    turn = Rotation.random(random_state=1).as_matrix()
    centres = 3 * poses[:, :, 3] @ turn.T + [1.0, 2, 3]
    return np.concatenate([turn @ poses[:, :, :3], centres[..., None]], axis=2)


def test_another_world_is_no_error() -> None:
    turns, moves = errors(moved(TRUE), TRUE)
    assert turns.max() < 1e-5
    assert moves.max() < 1e-5


def test_a_camera_that_is_off_is_found() -> None:
    found = TRUE.copy()
    found[4, :, :3] = Rotation.from_euler("x", 2, degrees=True).as_matrix() @ found[4, :, :3]
    found[5, :, 3] += 1e-3
    turns, moves = errors(moved(found), TRUE)
    extent = np.ptp(TRUE[:, :, 3], axis=0).max()
    assert turns.argmax() == 4
    assert abs(turns[4] - 2) < 0.05
    assert moves.argmax() == 5
    assert 0.7 * 100 * np.sqrt(3) * 1e-3 / extent < moves[5] < 100 * np.sqrt(3) * 1e-3 / extent
