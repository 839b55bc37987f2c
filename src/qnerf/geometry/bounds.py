"""Where rays begin and end: at the user's bounds, else at the scene's, made to fit its cameras, else at common ones."""

import numpy as np
from numpy.typing import NDArray

from qnerf.scenes.base import Scene

NEAR, FAR = 0.05, 1000.0  # world units, of a scene without bounds
AROUND = 0.4  # of the distance to what the cameras look at: bounds need not hold more than that around it


def bounds_of(scene: Scene, near: float | None, far: float | None) -> tuple[float, float]:
    """Distances at which the scene's rays begin and end, world units.

    near, far: the user's; None: the scene's times `misfit`, if it has some, else `NEAR` and `FAR`.

    Raises:
        ValueError: near is not below far.
    """
    factor = misfit(scene) or 1
    near = next(one for one in (near, scene.near and scene.near * factor, NEAR) if one is not None)
    far = next(one for one in (far, scene.far and scene.far * factor, FAR) if one is not None)
    if not 0 <= near < far:
        raise ValueError(f"scene {scene.name}: near must be at least 0 and below far, got {near:g} and {far:g}")
    return near, far


def misfit(scene: Scene) -> float | None:
    """By what the scene's own bounds have to be multiplied, because they do not fit its cameras; None: they do.

    They fit if what the median training camera sees around the point that all look at lies between them. Otherwise the
    source has another scale than its format, and that point belongs in the middle. Where there is no such point,
    nothing speaks against the bounds.
    """
    poses = scene.cameras.poses.numpy()[scene.train]
    if scene.near is None or scene.far is None or (point := focus(poses)) is None:
        return None
    sides = scene.cameras.all_sizes.double() / (2 * scene.cameras.intrinsics[:, :2])
    around = min(AROUND, float(sides[scene.train].amin(1).median()))
    away = float(np.median(((point - poses[:, :, 3]) * -poses[:, :, 2]).sum(-1)))
    if scene.near <= away * (1 - around) and away * (1 + around) <= scene.far:
        return None
    return 2 * away / (scene.near + scene.far)


def described_bounds(scene: Scene, near: float, far: float) -> str:
    """What the line about a scene says of its bounds, near and far being those that act."""
    told = f"rays from {near:.3g} to {far:.4g} world units"
    if (factor := misfit(scene)) is None or scene.near is None or scene.far is None:
        return told
    unit = float(np.linalg.norm(scene.transform.numpy()[:3, 0]))
    ends, away = f"near {scene.near / unit:.3g} and far {scene.far / unit:.3g}", factor * (scene.near + scene.far) / 2
    return f"{told}: {ends} do not fit the cameras, which look at a point {away / unit:.3g} away"


def focus(poses: NDArray) -> NDArray | None:
    """The point (3,) nearest to all optical axes; None unless most cameras see it near the middle of their picture."""
    centres, axes = poses[:, :, 3], -poses[:, :, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = across.sum(0)
    if np.linalg.cond(total) > 1e3:  # they look the same way
        return None
    point = np.linalg.solve(total, (across @ centres[..., None])[..., 0].sum(0))
    along = ((point - centres) * axes).sum(-1)
    beside = np.linalg.norm((across @ (point - centres)[..., None])[..., 0], axis=-1)
    return point if np.median(along - 2 * beside) > 0 else None
