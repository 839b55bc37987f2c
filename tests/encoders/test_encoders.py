"""Encodings of points and of view directions: encoders/."""

import math

import pytest
import torch
from torch.autograd import gradcheck

from qnerf.encoders import DIRECTIONS, ENCODERS, HashEncoder, spherical_harmonics
from qnerf.kernels.hashgrid import hash_encode_reference

TINY_HASH = {"levels": 3, "max_resolution": 40, "log2_table_size": 8, "features": 2}
OPTIONS = {
    "hash": [TINY_HASH, {**TINY_HASH, "dense": False}],
    "none": [{}],
    "signed": [{}],
    "pe": [{}, {"bands": 4, "max_exponent": 3.0, "include_input": True}],
    "rff": [{}, {"features": 7, "scale": 2.0, "seed": 3}],
}
EVERY = [(name, options) for name, several in OPTIONS.items() for options in several]


def test_every_encoder_is_tested():
    assert ENCODERS.names() == sorted(OPTIONS)


def test_every_encoder_keeps_shape_dtype_derivative_and_nan():
    for name, options in EVERY:
        encoder = ENCODERS.build(name, 3, **options)
        encoded = encoder(torch.tensor([[0.0, 0, 0], [1, 1, 1], [float("nan")] * 3, [0.5, 0.5, 0.5]]))
        assert encoded[2].isnan().all()
        assert encoded[[0, 1, 3]].isfinite().all()
        for dtype in (torch.float32, torch.float64):
            encoder.to(dtype)
            for shape in ((3,), (5, 3), (2, 4, 3), (0, 3)):
                encoded = encoder(torch.full(shape, 0.3, dtype=dtype))
                assert encoded.shape == (*shape[:-1], encoder.out_dim)
                assert encoded.dtype == dtype
        points = torch.rand(4, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64, requires_grad=True)
        assert gradcheck(encoder, (points,), eps=1e-7, atol=1e-3, rtol=1e-5)


# Positional encoding and random Fourier features


def test_positional_encoding_order_and_frequencies():
    encoder = ENCODERS.build("pe", 3)
    assert encoder.out_dim == 60
    torch.testing.assert_close(encoder.frequencies[[0, -1]], torch.tensor([1.0, 256.0], dtype=torch.float64))
    ratio = encoder.frequencies[1:] / encoder.frequencies[:-1]
    torch.testing.assert_close(ratio, torch.full((9,), 2 ** (8 / 9), dtype=torch.float64))
    point = torch.tensor([[0.1, 0.2, 0.7]], dtype=torch.float64)
    phase = 2 * math.pi * (point[0, :, None] * encoder.frequencies).flatten()
    torch.testing.assert_close(encoder(point)[0], torch.cat((phase.sin(), phase.cos())), rtol=0, atol=1e-11)


def test_positional_encoding_with_its_input():
    encoder = ENCODERS.build("pe", 3, bands=2, include_input=True)
    point = torch.tensor([[0.1, 0.2, 0.7]])
    assert encoder.out_dim == 15
    assert torch.equal(encoder(point)[:, 12:], point)


def test_frequencies_survive_a_cast():
    encoder = ENCODERS.build("pe", 3).half().float()
    assert torch.equal(encoder.frequencies, ENCODERS.build("pe", 3).frequencies)


def test_fourier_features_are_fixed_by_their_seed():
    state = torch.random.get_rng_state()
    first, same, other = (ENCODERS.build("rff", 3, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(torch.random.get_rng_state(), state)
    assert torch.equal(first.directions, same.directions)
    assert not torch.equal(first.directions, other.directions)
    assert first.out_dim == 60
    assert not list(first.parameters())
    assert "directions" in first.state_dict()


def test_fourier_features_draw_from_a_normal_distribution():
    b = ENCODERS.build("rff", 3, features=20000, scale=5.0).directions.flatten()
    count = b.numel()
    assert abs(b.mean().item()) < 5 * 5.0 / math.sqrt(count)
    assert abs(b.std().item() / 5.0 - 1) < 5 / math.sqrt(2 * count)
    assert abs((b.abs() < 5.0).double().mean().item() - 0.6827) < 5 * 0.466 / math.sqrt(count)


# Hash encoding


def test_hash_table_starts_small_and_from_the_given_generator():
    first, same, other = (HashEncoder(3, torch.Generator().manual_seed(seed), **TINY_HASH).table for seed in (0, 0, 1))
    assert torch.equal(first, same)
    assert not torch.equal(first, other)
    assert first.abs().max() <= 1e-3
    assert abs(first.std().item() - 1e-3 / math.sqrt(3)) < 5e-5
    torch.manual_seed(7)
    a = HashEncoder(3, **TINY_HASH).table
    torch.manual_seed(7)
    assert torch.equal(a, HashEncoder(3, **TINY_HASH).table)


def test_hash_encoder_is_its_table_and_resolutions():
    encoder = HashEncoder(3, **TINY_HASH)
    points = torch.rand(4, 6, 3, generator=torch.Generator().manual_seed(0))
    expected = hash_encode_reference(points.view(-1, 3), encoder.table, torch.tensor([16, 25, 40]))
    torch.testing.assert_close(encoder(points), expected.view(4, 6, 6))
    assert list(encoder.state_dict()) == ["table"]


def test_sizes_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="max_resolution must be at least min_resolution=32, got 16"):
        ENCODERS.build("hash", 3, min_resolution=32, max_resolution=16)
    for name in ("none", "pe", "rff", "signed"):
        assert ENCODERS.build(name, 2)(torch.zeros(4, 2)).shape[0] == 4
        with pytest.raises(ValueError, match="in_dim must be between 1 and"):
            ENCODERS.build(name, 0)
    with pytest.raises(ValueError, match="points must have at most 3 coordinates, got 4"):
        ENCODERS.build("hash", 4)
    with pytest.raises(ValueError, match="directions must have 3 coordinates"):
        DIRECTIONS.build("sh", 2)


# View directions


def test_direction_components():
    assert DIRECTIONS.names() == ["raw", "sh"]
    directions = torch.nn.functional.normalize(torch.randn(5, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    sh = DIRECTIONS.build("sh", degree=3)
    assert sh.out_dim == 9
    assert torch.equal(sh(directions), spherical_harmonics(directions, 3))
    assert DIRECTIONS.build("sh").out_dim == 16
    raw = DIRECTIONS.build("raw")
    assert raw.out_dim == 3
    assert torch.equal(raw(directions), directions)
    assert torch.equal(DIRECTIONS.build("raw", scale=2.0)(directions), 2 * directions)
    moved = (directions + 1) / 2
    assert torch.equal(DIRECTIONS.build("raw", interval="unit")(directions), moved)
    assert torch.equal(DIRECTIONS.build("sh", interval="unit")(directions), spherical_harmonics(moved, 4))
    with pytest.raises(ValueError, match="interval expects one of signed, unit"):
        DIRECTIONS.build("raw", interval="both")
