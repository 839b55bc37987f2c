"""World frames: from the source's to the normalised one, with +z up and the cameras within [-1, 1]^3."""

import numpy as np
from numpy.typing import NDArray

MAX_RIGID_ERROR = 1e-3  # largest entry of |R^T R - I| that is taken as rounding
MAX_ENTRY = 1e12  # largest absolute entry of a pose
FAR_OUT = 20.0  # times as far from the middle as the farthest other view: such a view does not decide the scale


def rigid(pose: NDArray, label: str) -> tuple[NDArray, float]:
    """A pose (3 or 4, 4) with its rotation made exactly orthonormal, (3, 4) float64, and the factor that was taken out.

    Some tools write rotations times a number, such as the scale of a similarity. The columns then have equal lengths.

    Raises:
        ValueError: the shape is wrong, an entry is not finite, or the rotation, divided by the length of its columns,
            is off by more than 1e-3. The message starts with `label`.
    """
    if pose.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"{label}: transform_matrix must be 4 x 4, got shape {pose.shape}")
    if not (np.abs(pose) <= MAX_ENTRY).all():
        raise ValueError(f"{label}: transform_matrix holds NaN, infinity or a number beyond {MAX_ENTRY:g}")
    if pose.shape[0] == 4 and not np.allclose(pose[3], [0, 0, 0, 1], atol=MAX_RIGID_ERROR):
        raise ValueError(f"{label}: the last row of transform_matrix must be 0 0 0 1, got {pose[3].tolist()}")
    rotation = pose[:3, :3]
    square = float((rotation**2).sum()) / 3
    error = float(np.abs(rotation.T @ rotation / (square or 1) - np.eye(3)).max())
    if error > MAX_RIGID_ERROR:
        raise ValueError(
            f"{label}: transform_matrix is not rigid: its columns must be at right angles and equally long, "
            f"R^T R is off by {error:.2g}"
        )
    if np.linalg.det(rotation) < 0:
        raise ValueError(f"{label}: transform_matrix mirrors space: the determinant of its rotation is -1, not 1")
    left, _, right = np.linalg.svd(rotation)
    return np.concatenate([left @ right, pose[:3, 3:]], axis=1), square**0.5


def rotation_between(a: NDArray, b: NDArray) -> NDArray:
    """The smallest rotation (3, 3) that turns the direction of `a` (3,) into that of `b` (3,).

    >>> rotation_between(np.array([1.0, 0, 0]), np.array([0.0, 2, 0])) @ [1, 0, 0]
    array([0., 1., 0.])
    """
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    cosine = float(a @ b)
    if cosine < -1 + 1e-9:  # opposite directions: half a turn about any perpendicular axis
        axis = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
        axis /= np.linalg.norm(axis)
        return 2 * np.outer(axis, axis) - np.eye(3)
    x, y, z = np.cross(a, b)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + k + k @ k / (1 + cosine)


def far_out(centres: NDArray) -> NDArray[np.float64]:
    """Of camera centres (V, 3), how many times as far from their middle they are as the others: (V,), 0 for most.

    >>> far_out(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [4, 0, 0], [202, 0, 0]])).round().tolist()
    [0.0, 0.0, 0.0, 0.0, 0.0, 80.0]
    """
    away = np.linalg.norm(centres - np.median(centres, axis=0), axis=1)
    ordered = np.sort(away)
    for rank in range(len(away) - (len(away) - 1) // 4, len(away)):  # at most one view in four
        if 0 < FAR_OUT * ordered[rank - 1] < ordered[rank]:
            return np.where(away >= ordered[rank], away / ordered[rank - 1], 0.0)
    return np.zeros(len(away))


def normalise(poses: NDArray, *, orient: bool = True, centre: bool = True) -> tuple[NDArray, NDArray]:
    """Orients, centres and scales camera-to-world poses (V, 3, 4). Views that are `far_out` decide nothing of that.

    Args:
        orient: turn the mean of the cameras' up vectors to +z.
        centre: move the mean of the camera centres to the origin.

    Returns:
        The poses (V, 3, 4), the largest absolute coordinate of whose centres is 1, and the similarity (4, 4) that was
        applied to the world.

    Raises:
        ValueError: all cameras stand at one point, so there is no scale.
    """
    deciding = poses[far_out(poses[:, :, 3]) == 0]
    origin = deciding[:, :, 3].mean(axis=0) if centre else np.zeros(3)
    up = deciding[:, :, 1].mean(axis=0)
    turn = rotation_between(up, np.array([0.0, 0, 1])) if orient and np.linalg.norm(up) > 1e-6 else np.eye(3)
    centres = (poses[:, :, 3] - origin) @ turn.T
    size = float(np.abs((deciding[:, :, 3] - origin) @ turn.T).max())
    extent = float(np.ptp(deciding[:, :, 3], axis=0).max())
    if extent <= 1e-9 * max(float(np.abs(deciding[:, :, 3]).max()), 1e-30) or not size > 0:
        raise ValueError("all cameras stand at the same point: a radiance field needs views from different places")
    scale = 1 / size
    similarity = np.eye(4)
    similarity[:3, :3] = scale * turn
    similarity[:3, 3] = -scale * (turn @ origin)
    return np.concatenate([turn @ poses[:, :, :3], (scale * centres)[..., None]], axis=2), similarity
