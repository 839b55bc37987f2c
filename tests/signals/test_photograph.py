"""A photograph as a function: its pixels, the held-out ones, what an exact fit measures."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import skimage.data
import torch
from PIL import Image

from qnerf.signals import Photograph


def exact(values):
    """A fit that returns given values."""
    return SimpleNamespace(values=lambda points: values)


def test_points_are_pixel_centres_with_x_to_the_right_and_y_down(tmp_path):
    pixels = np.arange(4 * 3 * 3, dtype=np.uint8).reshape(3, 4, 3)  # 4 wide, 3 high
    Image.fromarray(pixels).save(tmp_path / "small.png")
    photograph = Photograph(path=str(tmp_path / "small.png"), size=None)
    for (x, y), value in zip(photograph.points, photograph.targets, strict=True):
        assert value.tolist() == (pixels[int(3 * y), int(4 * x)] / 255).tolist()
    assert photograph.name == "small.png"
    assert photograph.description() == "12 training points of 2 coordinates, 3 values each"


def test_the_middle_square_is_reduced():
    picture = skimage.data.coffee()  # 600 x 400
    photograph = Photograph(path="coffee", size=40)
    blocks = picture[:, 100:500].reshape(40, 10, 40, 10, 3).mean((1, 3)) / 255
    assert np.abs(photograph.truth.numpy() - blocks).mean() < 0.015  # the filter is wider than a block
    assert np.abs(photograph.truth.numpy() - blocks[::-1]).mean() > 0.1
    gray = Photograph(path="coffee", size=40, gray=True).truth.numpy()
    assert np.abs(gray[..., 0] - skimage.color.rgb2gray(photograph.truth.numpy())).max() < 1e-12


def test_unseen_pixels_are_measured_alone_and_never_trained_on():
    photograph = Photograph(size=16, held_out=0.25)
    assert (len(photograph.points), len(photograph.unseen)) == (192, 64)
    whole = {tuple(point) for point in photograph.everywhere.tolist()}
    assert whole - {tuple(point) for point in photograph.points.tolist()} == {
        tuple(point) for point in photograph.everywhere[photograph.unseen].tolist()
    }
    values = photograph.truth.view(-1, 3).clone()
    values[photograph.unseen] += torch.where(values[photograph.unseen] > 0.5, -0.1, 0.1)
    measured, panels = photograph.evaluate(exact(values))
    assert measured["psnr_unseen"] == pytest.approx(20)
    assert measured["psnr"] == pytest.approx(20 - 10 * math.log10(0.25))
    assert [panel.shape for panel in panels] == [(16, 16, 3)] * 3


def test_all_pixels_are_trained_on_by_default():
    photograph = Photograph(size=16)
    measured, _ = photograph.evaluate(exact(photograph.truth.view(-1, 3)))
    assert len(photograph.points) == 256
    octaves = {f"error_octave_{number}": 0 for number in (1, 2, 3)}
    assert measured == {"psnr": math.inf, "ssim": pytest.approx(1), "explained": 1, "psnr_unseen": None, **octaves}


@pytest.mark.parametrize("path", ["nobody", "../astronaut", ""])
def test_an_unknown_picture_is_one_line(path):
    with pytest.raises(ValueError, match=r"^no image file .*known: astronaut, .*camera, .*coffee"):
        Photograph(path=path)
