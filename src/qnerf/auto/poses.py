"""Whether the given cameras are off, and in what, judged by matching features in pairs of images."""

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial.transform import Rotation
from skimage.feature import SIFT, match_descriptors
from skimage.measure import ransac
from skimage.transform import FundamentalMatrixTransform, rescale

from qnerf.auto.views import grey, neighbours, subset
from qnerf.scenes import Cameras, Scene

PAIRS = 8  # most pairs of views to compare
MIN_MATCHES = 20  # pairs of views with fewer consistent matches are left out
WITHIN = 1.0  # pixels: a match this close to its epipolar line is consistent
OUTLINE = 2.0  # features this close to a transparent pixel are left out
OFF = 0.15  # pixels: poses whose matches fit worse than the best by more are off; true poses stay below 0.06
WRONG = 1.0  # pixels: poses that are off by more are not merely imprecise
EXPLAINED = 0.35  # share of the error that may be left where one thing explains it; nor may it be `WRONG`
SMALL = 256  # pixels: smaller images are enlarged to this height before matching, at most four times


FACTORS = tuple(2 ** (step / 4) for step in range(-12, 13) if step)  # by which a focal length may be wrong
AXES, DIRECTION, BOTH, QUATERNIONS = "axes", "direction", "both", "quaternions"
CENTRE, FOCAL = "centre", "focal"


@dataclass(frozen=True)
class Epipolar:
    """How far matched features lie from the epipolar lines of the given poses, in pixels; NaN: too few matches."""

    given: float  # median distance under the given poses
    best: float  # under the fundamental matrix that fits each pair of views best
    pairs: int  # pairs of views with enough matches
    others: Mapping[str, float]  # under the given poses with one thing changed, see `changes`


def epipolar_error(scene: Scene) -> Epipolar:
    """Compares the given poses of neighbouring views with the geometry that their images imply.

    Lens distortion is not removed; it adds to all distances alike.
    """
    changed = {"": scene.cameras, **changes(scene)}
    found = [pair_error(scene, changed, a, b) for a, b in subset(neighbours(scene), PAIRS)]
    known = np.array([pair for pair in found if pair is not None]).reshape(-1, 1 + len(changed))
    if len(known) == 0:
        return Epipolar(math.nan, math.nan, 0, {})
    best, given, *others = np.median(known, axis=0).tolist()
    return Epipolar(given, best, len(known), dict(zip(list(changed)[1:], others, strict=True)))


def changes(scene: Scene) -> dict[str, Cameras]:
    """The cameras with one thing changed that files often have wrong.

    In the source's world, whose origin matters if a pose is inverted: turned axes, as if they were OpenCV's; poses as
    if they were from the world to the camera; both; quaternions of COLMAP's poses whose real part came last. Then the
    principal point in the middle of the image, and the focal length times a number, which follows the name.
    """
    cameras, flip = scene.cameras, np.diag([1.0, -1.0, -1.0, 1.0])
    similarity = scene.transform.numpy()
    poses = np.tile(np.eye(4), (len(cameras), 1, 1))
    poses[:, :3] = cameras.poses.numpy()
    poses = np.linalg.inv(similarity) @ poses
    poses[:, :3, :3] *= np.linalg.norm(similarity[:3, 0])
    inverse, colmap = np.linalg.inv(poses), np.linalg.inv(poses @ flip)
    colmap[:, :3, :3] = Rotation.from_quat(np.roll(Rotation.from_matrix(colmap[:, :3, :3]).as_quat(), 1, 1)).as_matrix()
    others = {
        AXES: poses @ flip,
        DIRECTION: inverse,
        BOTH: inverse @ flip,
        QUATERNIONS: np.linalg.inv(colmap) @ flip,
    }
    middle = cameras.all_sizes.to(torch.float64).unbind(1)
    return {
        **{name: replace(cameras, poses=torch.from_numpy(changed[:, :3])) for name, changed in others.items()},
        CENTRE: replace(cameras, cx=middle[0] / 2, cy=middle[1] / 2),
        **{
            f"{FOCAL} {factor:.3g}": replace(cameras, fx=cameras.fx * factor, fy=cameras.fy * factor)
            for factor in FACTORS
        },
    }


def warning(scene: Scene) -> str | None:
    """One line if the images contradict the given cameras; it names what explains them better. Else None."""
    error = epipolar_error(scene)
    off = error.given - error.best
    if not off > OFF:  # also NaN
        return None
    told = f"matched features lie {error.given:.2g} pixels from where the poses put them, {error.best:.2g} at best"
    likely = min(error.others, key=lambda name: error.others[name])
    left = error.others[likely]
    if left - error.best < EXPLAINED * off and left < WRONG:
        return f"{EXPLANATIONS[likely.split()[0]].format(factor=likely.split()[-1])}: {told}, {left:.2g} so changed"
    if off > WRONG:
        return (
            f"the poses do not fit the images: {told}; axes, direction, principal point and focal length alone do not "
            "explain it; `qnerf capture` finds poses from the images"
        )
    return None


EXPLANATIONS = {
    AXES: "the poses seem to have OpenCV's axes, and OpenGL's are expected (multiply columns 2 and 3 of each "
    "transform_matrix by -1)",
    DIRECTION: "the poses seem to be from the world to the camera, and those from the camera to the world are expected "
    "(invert each transform_matrix)",
    BOTH: "the poses seem to be inverted: expected are those from the camera to the world, with OpenGL's axes (invert "
    "each transform_matrix, then multiply its columns 2 and 3 by -1), and in COLMAP's images.txt those from the world "
    "to the camera (invert each)",
    QUATERNIONS: "the quaternions seem to be in the order qx qy qz qw, and images.txt holds qw qx qy qz",
    CENTRE: "the principal point seems to be wrong (cx and cy are in pixels; left out, it is the middle of the image)",
    FOCAL: "the focal length seems to be wrong (about {factor} times fl_x would fit; it is in pixels of the images)",
}
"""What is said where a change of the cameras explains the images, and what to do."""


def pair_error(scene: Scene, changed: Mapping[str, Cameras], a: int, b: int) -> list[float] | None:
    """Median distances from epipolar lines: under the matrix that fits best, then under all of the cameras; or None."""
    points = matched(grey(scene, a), grey(scene, b))
    if len(points) < MIN_MATCHES:
        return None
    with warnings.catch_warnings(action="ignore"):  # it returns None if it finds no model
        model, explained = ransac(
            (points[:, 0], points[:, 1]),
            FundamentalMatrixTransform,
            min_samples=8,
            residual_threshold=WITHIN,
            max_trials=200,
            rng=np.random.default_rng(0),
        )
    if not model or explained.sum() < MIN_MATCHES:
        return None
    points = points[explained]
    matrices = [model.params, *(fundamental(cameras, a, b) for cameras in changed.values())]
    return [float(np.median(distances(matrix, points))) for matrix in matrices]


def matched(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Features that both images show (N, 2, 2): which image, then x and y in pixels.

    Features at a silhouette are left out, because each view sees another outline of the object.
    """
    features = []
    for image in (a, b):
        factor = float(np.clip(SMALL / image.shape[0], 1, 4))
        large = rescale(np.nan_to_num(image, nan=1.0), factor, order=3)
        detector = SIFT(upsampling=1)
        try:
            detector.detect_and_extract(np.clip(large, 0, 1))
        except (RuntimeError, IndexError):  # no features, or an image of a few pixels
            return np.empty((0, 2, 2))
        keypoints = (detector.keypoints[:, ::-1] + 0.5) / factor
        features.append((keypoints, detector.descriptors))
    pairs = match_descriptors(features[0][1], features[1][1], max_ratio=0.75, cross_check=True)
    points = np.stack([features[side][0][pairs[:, side]] for side in (0, 1)], axis=1)
    return points[off_outline(a, points[:, 0]) & off_outline(b, points[:, 1])]


def off_outline(image: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether the points (N, 2), in pixels, lie on the object and not at its outline."""
    solid = np.isfinite(image)
    if solid.all():
        return np.ones(len(points), dtype=bool)
    column, row = np.minimum(points.astype(int), [image.shape[1] - 1, image.shape[0] - 1]).T
    inside: NDArray[np.bool_] = distance_transform_edt(solid)[row, column] > OUTLINE
    return inside


def fundamental(cameras: Cameras, a: int, b: int) -> NDArray[np.float64]:
    """The matrix (3, 3) for which x_b^T F x_a = 0 at pixels of the same point."""
    poses, intrinsics = cameras.poses.numpy(), cameras.intrinsics.numpy()
    flip = np.diag([1.0, -1.0, -1.0])  # OpenGL's axes -> x right, y down
    inverse = []
    for view in (a, b):
        fx, fy, cx, cy = intrinsics[view, :4]
        inverse.append(np.array([[1 / fx, 0, -cx / fx], [0, 1 / fy, -cy / fy], [0, 0, 1]]))
    turn_a, turn_b = poses[a, :, :3] @ flip, poses[b, :, :3] @ flip
    turn = turn_b.T @ turn_a
    x, y, z = turn_b.T @ (poses[a, :, 3] - poses[b, :, 3])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix: NDArray[np.float64] = inverse[1].T @ cross @ turn @ inverse[0]
    return matrix


def distances(matrix: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of each match (N, 2, 2) from its epipolar line, the mean of both images', in pixels: (N,)."""
    first, second = (np.concatenate([points[:, side], np.ones((len(points), 1))], axis=1) for side in (0, 1))
    in_second, in_first = first @ matrix.T, second @ matrix
    algebraic = np.abs((second * in_second).sum(-1))
    lengths = [np.maximum(np.linalg.norm(line[:, :2], axis=-1), 1e-12) for line in (in_second, in_first)]
    mean: NDArray[np.float64] = 0.5 * (algebraic / lengths[0] + algebraic / lengths[1])
    return mean
