"""Exact distances, against a brute search over the surface, scikit-image's solid and scipy's distance transform."""

import numpy as np
import skimage.data
import skimage.draw
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import binary_fill_holes, distance_transform_edt

from qnerf.signals import Distance
from qnerf.signals.shapes import SEMI_AXES, ellipsoid, horse, outline


@given(st.tuples(*[st.floats(0, 1)] * 3))
def test_the_gradient_of_the_ellipsoids_distance_has_length_1_and_leads_to_the_surface(point):
    step = 1e-5
    offsets = np.concatenate([np.eye(3), -np.eye(3)]) * step
    values = ellipsoid(point + offsets)
    gradient = (values[:3] - values[3:]) / (2 * step)
    distance = ellipsoid(np.array([point]))[0]
    if distance > -0.05:  # inside, the distance has edges where two surface points are equally near
        assert abs(np.linalg.norm(gradient) - 1) < 1e-4
        assert abs(ellipsoid(np.array([point - distance * gradient]))[0]) < 1e-4


def test_the_ellipsoid_is_scikit_images():
    scale = 50
    solid = skimage.draw.ellipsoid(*(np.array(SEMI_AXES) * scale))
    index = np.stack(np.meshgrid(*map(np.arange, solid.shape), indexing="ij"), -1).reshape(-1, 3)
    middle = (np.array(solid.shape) - 1) / 2
    inside = ellipsoid(0.5 + (index - middle) / scale) < 0
    assert (inside == solid.reshape(-1)).mean() > 0.999  # its own border may differ


def test_the_horse_is_scikit_images_and_its_distance_is_scipys():
    """scipy's distance is of pixel centres, and the polygon may leave the outline by a pixel."""
    silhouette = binary_fill_holes(np.pad(~skimage.data.horse(), 1))
    corners = outline()
    assert (corners[0] == corners[-1]).all()
    rows, columns = np.nonzero(silhouette)
    pixel = (corners.max(0) - corners.min(0)).max() / max(np.ptp(rows) + 1, np.ptp(columns) + 1)
    height, width = silhouette.shape
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    middle = np.array([columns.min() + columns.max(), rows.min() + rows.max()]) / 2
    points = 0.5 + (np.stack([x, y], -1).reshape(-1, 2)[::37] - middle) * pixel
    inner, outer = distance_transform_edt(silhouette), distance_transform_edt(~silhouette)
    expected = ((outer - inner) * pixel).reshape(-1)[::37]
    assert np.abs(horse(points) - expected).max() < 2 * pixel


def test_an_exact_fit_has_no_error_and_training_points_are_not_measured():
    class Exact:
        def __init__(self, signal):
            self.values = signal.distances

        def gradients(self, points):
            return torch.nn.functional.one_hot(torch.zeros(len(points), dtype=torch.long), points.shape[1]).double()

    for shape, dims in (("horse", 2), ("ellipsoid", 3)):
        signal = Distance(shape=shape, samples=50)
        assert signal.points.shape == (50, dims)
        measured, panels = signal.evaluate(Exact(signal))
        assert measured.pop("iou") == 1
        assert set(measured.values()) == {0}
        assert bool((panels[0] == panels[1]).all())
        assert float(panels[2].max()) == 0
        assert float(torch.cdist(signal.points, signal.unseen).min()) > 0
