"""World frames: from a source's own to the one in which cameras stand within [-1, 1]^3 and up is +z."""

import numpy as np
from numpy.typing import NDArray

RIGID = 1e-3  # how far R^T R may be from the identity
LARGEST = 1e12  # absolute entry of a pose


def rigid(pose: NDArray, frame: str) -> NDArray:
    """The pose (3 or 4, 4) as an exact rotation and a translation (3, 4) float64.

    Raises:
        ValueError: not numbers, not finite, or not a rotation to within 1e-3; says which `frame`.
    """
    if pose.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"{frame}: transform_matrix must be 4 x 4, got shape {pose.shape}")
    if not (np.abs(pose) <= LARGEST).all():
        raise ValueError(f"{frame}: transform_matrix holds NaN, infinity or a number beyond {LARGEST:g}")
    if pose.shape[0] == 4 and not np.allclose(pose[3], [0, 0, 0, 1], atol=RIGID):
        raise ValueError(f"{frame}: the last row of transform_matrix must be 0 0 0 1, got {pose[3].tolist()}")
    rotation = pose[:3, :3]
    error = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if error > RIGID:
        raise ValueError(
            f"{frame}: transform_matrix is not rigid: its columns must be orthonormal, R^T R is off by {error:.2g}"
        )
    if np.linalg.det(rotation) < 0:
        raise ValueError(f"{frame}: transform_matrix mirrors space: the determinant of its rotation is -1, not 1")
    left, _, right = np.linalg.svd(rotation)
    return np.concatenate([left @ right, pose[:3, 3:]], axis=1)


def rotation_between(a: NDArray, b: NDArray) -> NDArray:
    """The smallest rotation (3, 3) that takes the direction of `a` (3,) to that of `b` (3,)."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    cosine = float(a @ b)
    if cosine < -1 + 1e-9:  # opposite: half a turn about any axis across
        axis = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
        axis /= np.linalg.norm(axis)
        return 2 * np.outer(axis, axis) - np.eye(3)
    x, y, z = np.cross(a, b)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + k + k @ k / (1 + cosine)


def normalise(poses: NDArray, *, orient: bool = True, centre: bool = True) -> tuple[NDArray, NDArray]:
    """Orients, centres and scales camera poses (V, 3, 4): the mean camera's up becomes +z, the mean centre the origin,
    the largest absolute coordinate of a centre 1.

    Returns:
        The poses (V, 3, 4), rotations still rotations, and the similarity (4, 4) that was applied to the world.

    Raises:
        ValueError: all cameras stand at one point, so that there is no scale.
    """
    origin = poses[:, :, 3].mean(axis=0) if centre else np.zeros(3)
    up = poses[:, :, 1].mean(axis=0)
    turn = rotation_between(up, np.array([0.0, 0, 1])) if orient and np.linalg.norm(up) > 1e-6 else np.eye(3)
    centres = (poses[:, :, 3] - origin) @ turn.T
    size = float(np.abs(centres).max())
    spread = float(np.ptp(poses[:, :, 3], axis=0).max())
    if spread <= 1e-9 * max(float(np.abs(poses[:, :, 3]).max()), 1e-30) or not size > 0:
        raise ValueError("all cameras stand at the same point: a radiance field needs views from different places")
    scale = 1 / size
    similarity = np.eye(4)
    similarity[:3, :3] = scale * turn
    similarity[:3, 3] = -scale * (turn @ origin)
    return np.concatenate([turn @ poses[:, :, :3], (scale * centres)[..., None]], axis=2), similarity
