import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from qnerf.training import lpips as lpips_module
from qnerf.training.image_metrics import (
    VIEW_DEPENDENT,
    Comparison,
    depth_error,
    lpips,
    measure,
    octave_energies,
    octave_errors,
    psnr,
    ssim,
)
from qnerf.training.lpips import BACKBONE, HEADS, VARIABLE


def images(height=36, width=64, noise=0.05):
    generator = torch.Generator().manual_seed(0)
    truth = torch.rand(height, width, 3, generator=generator)
    return (truth + noise * torch.randn(height, width, 3, generator=generator)).clamp(0, 1), truth


def test_psnr():
    truth = torch.zeros(4, 5, 3)
    assert psnr(truth + 0.1, truth) == pytest.approx(20.0)
    assert psnr(truth + 1, truth) == 0
    assert psnr(truth, truth) == math.inf


def test_psnr_of_nan_is_nan():
    assert math.isnan(psnr(torch.full((2, 2, 3), math.nan), torch.zeros(2, 2, 3)))


@pytest.mark.parametrize("metric", [psnr, ssim])
def test_images_of_two_sizes_are_refused(metric):
    with pytest.raises(ValueError, match=r"one size expected, got \(4, 5, 3\) and \(5, 4, 3\)"):
        metric(torch.zeros(4, 5, 3), torch.zeros(5, 4, 3))


def windowed_ssim(image, truth, radius):
    """The definition, by convolution with a Gaussian window over the interior."""
    offset = torch.arange(-radius, radius + 1, dtype=torch.float64)
    sigma = 1.5 if radius == 5 else radius / 3.5
    line = torch.exp(-(offset**2) / (2 * sigma**2))
    window = torch.outer(line, line)
    window = (window / window.sum())[None, None]
    x, y = (i.double().permute(2, 0, 1)[:, None] for i in (image, truth))

    def mean(z):
        return torch.nn.functional.conv2d(z, window)

    mx, my = mean(x), mean(y)
    vx, vy, cov = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    return float(((2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))).mean())


def test_ssim_against_its_definition():
    for height, width, radius in ((36, 64, 5), (11, 11, 5), (10, 30, 4), (5, 9, 2), (3, 3, 1)):
        image, truth = images(height, width)
        assert ssim(image, truth) == pytest.approx(windowed_ssim(image, truth, radius), abs=1e-9)


def test_ssim_of_identical_constant_and_tiny_images():
    image, truth = images()
    assert ssim(truth, truth) == pytest.approx(1)
    grey = torch.full((20, 20, 3), 0.5)
    assert ssim(grey, grey) == pytest.approx(1)
    assert 0 < ssim(grey, grey * 0.5) < 1
    assert ssim(image[:2], truth[:2]) is None


def test_depth_error_counts_known_pixels_only():
    truth = torch.tensor([[1.0, 2.0, math.inf], [math.nan, 0.0, 4.0]])
    depth = torch.tensor([[1.5, 2.0, 7.0], [7.0, 7.0, 3.0]])
    relative, median = depth_error(depth, truth)
    assert relative == pytest.approx((0.5 / 1.5 + 0 + 0.25) / 3)
    assert median == pytest.approx(0.5)
    assert all(math.isnan(value) for value in depth_error(depth, torch.full((2, 3), math.inf)))
    with pytest.raises(ValueError, match="one size"):
        depth_error(depth, truth[:1])


def save_random_weights(folder):
    """AlexNet's layers as torchvision names them, and heads; both random."""
    torch.manual_seed(0)
    conv, relu, pool = torch.nn.Conv2d, torch.nn.ReLU(), torch.nn.MaxPool2d(3, 2)
    network = torch.nn.Sequential(
        conv(3, 64, 11, 4, 2), relu, pool, conv(64, 192, 5, padding=2), relu, pool, conv(192, 384, 3, padding=1), relu,
        conv(384, 256, 3, padding=1), relu, conv(256, 256, 3, padding=1), relu,
    )  # fmt: skip
    heads = [torch.rand(channels) for channels in (64, 192, 384, 256, 256)]
    features = {f"features.{key}": value for key, value in network.state_dict().items()}
    torch.save(features | {"classifier.1.weight": torch.zeros(1)}, folder / BACKBONE)
    torch.save({f"lin{i}.model.1.weight": head.view(1, -1, 1, 1) for i, head in enumerate(heads)}, folder / HEADS)
    lpips_module.load.cache_clear()
    return network, heads


def test_lpips_is_the_weighted_distance_of_normalised_features(tmp_path, monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    image, truth = images()
    value, reason = lpips(image, truth)
    assert value is None
    assert VARIABLE in str(reason)
    network, heads = save_random_weights(tmp_path)
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    x = ((torch.stack([image, truth]) * 2 - 1 - shift) / scale).permute(0, 3, 1, 2)
    expected = 0.0
    for layer in network:
        x = layer(x)
        if isinstance(layer, torch.nn.ReLU):
            one, other = (x / x.norm(dim=1, keepdim=True).clamp(min=1e-10)).detach().double()
            expected += float(torch.einsum("c,chw->hw", heads.pop(0).double(), (one - other).square()).mean())
    assert lpips(image.double(), truth.double()) == (pytest.approx(expected, rel=1e-5), None)
    assert lpips(truth, truth) == (0.0, None)
    nearer, _ = lpips(images(noise=0.01)[0], truth)
    assert nearer is not None
    assert 0 < nearer < expected
    assert lpips(image[:30], truth[:30]) == (None, "images of 30 x 64 pixels are too small, 31 are needed")
    assert lpips(image[:31, :31], truth[:31, :31])[0] is not None


def test_lpips_refuses_what_is_not_its_weights(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    for name, content in ((BACKBONE, {"features.0.weight": torch.zeros(1)}), (HEADS, {})):
        save_random_weights(tmp_path)
        torch.save(content, tmp_path / name)
        with pytest.raises(ValueError, match=r"expected torchvision's alexnet.* and the alex\.pth of LPIPS 0\.1"):
            lpips(*images())


def test_masked_pixels_are_not_counted():
    """Whatever stands behind the mask changes nothing; what is left is measured as if it were the image."""
    image, truth = (part.double() for part in images())
    depth, mask = torch.rand(36, 64), torch.ones(36, 64, dtype=torch.bool)
    mask[:, :20] = False
    measured = []
    for behind in (0.0, 1.0):
        spoiled = torch.where(mask[..., None], image, behind)
        measured.append(measure(Comparison(spoiled, truth, depth, 2 * depth, mask)))
    assert measured[0] == measured[1]
    assert measured[0]["psnr"] == pytest.approx(psnr(image[:, 20:], truth[:, 20:]))
    assert measured[0]["ssim"] == pytest.approx(ssim(image[:, 20:], truth[:, 20:]))
    assert measured[0]["depth_error"] == pytest.approx(0.5)
    assert (measured[0]["lpips"], measured[0]["lpips_reason"]) == (None, "masked pixels cannot be left out of it")
    nothing = measure(Comparison(image, truth, depth, None, torch.zeros_like(mask)))
    assert nothing["psnr"] is nothing["ssim"] is None


def test_view_dependent_pixels_are_measured_apart():
    """Errors of 0.1 where specular light is at the threshold, and of 0.01 below it; a masked pixel counts nowhere."""
    specular = torch.tensor([[VIEW_DEPENDENT, 255, VIEW_DEPENDENT - 1, 0, 255]], dtype=torch.uint8)
    truth, error = torch.zeros(1, 5, 3), torch.tensor([[0.1, 0.1, 0.01, 0.01, 0.9]])[..., None].double()
    mask, depth = torch.tensor([[True, True, True, True, False]]), torch.ones(1, 5)
    found = measure(Comparison(truth + error, truth.double(), depth, None, mask, specular=specular))
    assert found["psnr_view_dependent"] == pytest.approx(20)
    assert found["psnr_diffuse"] == pytest.approx(40)
    nowhere = measure(Comparison(truth + error, truth.double(), depth, None, specular=torch.zeros_like(specular)))
    assert nowhere["psnr_view_dependent"] is None
    assert nowhere["psnr_diffuse"] == nowhere["psnr"]
    unknown = measure(Comparison(truth + error, truth.double(), depth, None))
    assert unknown["psnr_view_dependent"] is unknown["psnr_diffuse"] is None


def test_explained_variance_tells_a_picture_from_one_colour():
    _, truth = (part.double() for part in images())
    depth, solid = torch.rand(36, 64), torch.zeros(36, 64, dtype=torch.bool)
    solid[:, 30:] = True
    grey = truth[solid].mean(0).expand_as(truth)
    shown = {"itself": truth, "one colour": grey, "nothing": torch.ones_like(truth)}
    found = {
        name: measure(Comparison(image, truth, depth, None, None, solid))["explained"] for name, image in shown.items()
    }
    assert found["itself"] == 1
    assert found["one colour"] == pytest.approx(0, abs=1e-12)
    assert found["nothing"] < 0
    assert measure(Comparison(grey, grey, depth, None))["explained"] is None  # there is nothing to explain


@given(st.lists(st.integers(1, 12), min_size=1, max_size=3), st.floats(-2, 2))
def test_octaves_share_out_the_energy_and_scale_with_it(sides, part):
    values = torch.rand(*sides, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    energies = octave_energies(values)
    assert energies.sum() == pytest.approx(float(values.square().sum()))
    assert energies[0] == pytest.approx(float(values.mean(list(range(len(sides)))).square().sum()) * math.prod(sides))
    shared = octave_errors((1 - part) * values, values).values()
    assert [value for value in shared if value is not None] == pytest.approx([part**2] * sum(energies[1:] > 0))


def test_a_wave_lies_in_the_octave_of_its_cycles_along_the_longest_side():
    x = (torch.arange(64, dtype=torch.float64) + 0.5) / 64
    for cycles, octave in ((0.5, 1), (1.5, 1), (2, 2), (3.5, 2), (4, 3), (31.5, 5)):
        wave = torch.cos(2 * torch.pi * cycles * x).expand(36, 64)[..., None]
        assert octave_energies(wave).argmax() == octave
        assert octave_energies(wave.transpose(0, 1)).argmax() == octave
    missing = octave_errors(0 * wave, wave)
    assert missing == {f"error_octave_{number}": None if number < 5 else pytest.approx(1) for number in range(1, 6)}
