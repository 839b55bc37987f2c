"""Metrics of images that have nothing in them, and of too few pixels."""

import math
import warnings

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from qnerf.analysis import hsv

from qnerf.training.image_metrics import depth_error, psnr, ssim

SHADES = st.tuples(*[st.floats(0, 1, width=32)] * 3)


def constant(shade: tuple[float, ...], height: int = 12, width: int = 13) -> torch.Tensor:
    return torch.tensor(shade, dtype=torch.float32).expand(height, width, 3)


@given(shade=SHADES)
def test_psnr_of_identical_images_is_infinite_and_one_ulp_apart_is_not(shade: tuple[float, ...]) -> None:
    image = constant(shade)
    assert psnr(image, image) == math.inf
    near = image.clone()
    near[3, 4, 1] = near[3, 4, 1].nextafter(torch.tensor(2.0))
    found = psnr(near, image)
    assert 140 < found < math.inf


@given(first=SHADES, second=SHADES)
def test_ssim_of_constant_images_is_their_luminance_alone(first: tuple[float, ...], second: tuple[float, ...]) -> None:
    """No variance: (2 a b + C1) / (a^2 + b^2 + C1), within the rounding of the variances over C2 = 9e-4."""
    found = ssim(constant(first), constant(second))
    a, b = (constant(shade)[0, 0].double().numpy() for shade in (first, second))
    expected = ((2 * a * b + 1e-4) / (a * a + b * b + 1e-4)).mean()
    assert found == pytest.approx(float(expected), abs=1e-12)


@given(height=st.integers(1, 14), width=st.integers(1, 14), seed=st.integers(0, 100))
def test_ssim_of_images_smaller_than_its_window(height: int, width: int, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    image, truth = (torch.rand(height, width, 3, generator=generator) for _ in range(2))
    found = ssim(image, truth)
    assert (found is None) == (min(height, width) < 3)
    if found is not None:
        assert -1 <= found <= 1
        assert ssim(truth, truth) == pytest.approx(1, abs=1e-12)


def test_depth_error_where_both_are_right_or_nothing_is_known() -> None:
    truth = torch.full((2, 2), 1e-38)
    assert depth_error(truth, truth) == (0, 0)
    assert all(map(math.isnan, depth_error(truth, torch.zeros(2, 2))))


@given(value=st.integers(0, 255))
def test_hue_of_grey(value: int) -> None:
    """Every grey, black and white included: no hue, no saturation, and no warning of a 0/0."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pixels = hsv.pixels(np.full((2, 3, 3), value, dtype=np.uint8))
    assert pixels["hue"].isna().all()
    assert (pixels["saturation"] == 0).all()
    assert pixels["value"].to_numpy() == pytest.approx(value / 255)
