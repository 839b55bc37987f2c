import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qnerf.heads.activations import DENSITY_ACTIVATIONS
from qnerf.kernels import plain
from qnerf.kernels.dispatch import report
from qnerf.rendering.render import color_shares, volume_weights
from qnerf.rendering.shading import SHADINGS, SMALL, shade
from tests.helpers.configs import TINY
from tests.helpers.trainer import built


def along(count, samples, seed):
    """Weights of rays, some of them empty."""
    generator = torch.Generator().manual_seed(seed)
    s = torch.rand(count, samples + 1, dtype=torch.float64, generator=generator).sort(-1).values
    density = torch.rand(count, samples, dtype=torch.float64, generator=generator).mul(12).sub(8).exp()
    density[0] = 0
    return volume_weights(density, s.diff())


def test_a_head_gets_two_samples_where_one_ray_alone_meets_something():
    """As many as its normalisation needs."""
    share, evaluated = torch.zeros(8, 5), torch.zeros(8, 5, dtype=torch.bool)
    share[3, 2], evaluated[3, 1:3] = 1.0, True
    mask = SHADINGS.build("merge")(share, torch.zeros(8, 5, 1), evaluated).mask
    assert int(mask.sum()) >= 2


@pytest.mark.parametrize("field", ["classical", "qcolor"])
@pytest.mark.parametrize("shading", SHADINGS.names())
def test_rays_that_pass_only_empty_space_are_white_under_every_shading(config, shading, field):
    """Then a shading may leave the colour head nothing at all to evaluate."""
    options = ["scene.views=6", "visibility.cameras=1", "visibility.resolution=4", "render.background=white"]
    _, _, model, table, watch = built(config(f"field={field}", "qiren.qubits=2", f"shading={shading}", *options, *TINY))
    model.eval()
    model.field.mask.grid = torch.zeros_like(model.field.mask.grid)
    rays, _ = table.batch(table.draw(16, torch.Generator().manual_seed(0)))
    rendering, _, _ = model(rays, background="white", step=0, watch=watch)
    assert torch.equal(rendering.color, torch.ones(16, 3))
    assert torch.equal(rendering.accumulation, torch.zeros(16))


@settings(max_examples=40)
@given(seed=st.integers(0, 2**20), samples=st.integers(1, 30), parts=st.integers(1, 40))
def test_merging_keeps_shares_and_their_sum_of_features(seed, samples, parts):
    """A colour that is linear in the features is exact: the features are means weighted by the shares."""
    share = color_shares(along(5, samples, seed), "last_sample")
    geometry = torch.randn(5, samples, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    merged, features, mask = SHADINGS.build("merge", parts=parts)(share, geometry)
    assert merged.shape == mask.shape == (5, parts)
    torch.testing.assert_close(merged.sum(-1), share.sum(-1))
    torch.testing.assert_close((merged[..., None] * features).sum(1), (share[..., None] * geometry).sum(1))
    filled = merged.sum(-1) > 0
    assert torch.equal(mask[filled], merged[filled] > 0)
    assert int(mask.sum()) >= min(2, mask.numel())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("activation", ["trunc_exp", "softplus"])
@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**20),
    samples=st.integers(2, 30),
    parts=st.integers(0, 12),
    features=st.integers(1, 6),
    background=st.sampled_from(["last_sample", "white"]),
    masked=st.booleans(),
)
def test_the_loop_from_raw_values_to_shares_agrees_with_its_reference(
    dtype, activation, seed, samples, parts, features, background, masked
):
    generator = torch.Generator().manual_seed(seed)
    raw = torch.randn(70, samples, 1 + features, dtype=torch.float64, generator=generator).to(dtype) - 1
    raw[0, ..., 0], raw[1, ..., 0] = -math.inf, 20.0  # an empty and an opaque ray
    raw.requires_grad_()
    deltas = torch.rand(70, samples, dtype=torch.float64, generator=generator).to(dtype)
    inside = torch.rand(70, samples, generator=generator) < 0.7 if masked else None
    shading = SHADINGS.build("merge", parts=parts) if parts else SHADINGS.build("none")
    arguments = (raw, inside, inside, deltas, DENSITY_ACTIVATIONS.get(activation), 0.3, background, shading)
    with report() as aside:
        weights, (shares, geometry, _) = shade(*arguments)
    assert not aside
    with plain():
        plain_weights, (plain_shares, plain_geometry, _) = shade(*arguments)
    fast, slow = (weights, shares, geometry), (plain_weights, plain_shares, plain_geometry)
    # Rounding may move a sample into the next part, and gives a part with next to no share another mean.
    share = color_shares(plain_weights, background).detach()
    middle = (share.cumsum(-1) - share / 2) / share.sum(-1, keepdim=True).clamp(min=1e-30) * parts
    same = ((middle[..., None] - torch.arange(1, max(parts, 1))).abs() > 1e-5).all(-1).all(-1)
    faint = 1e-3 if parts else 0
    same &= ((shares == 0) | (shares > faint)).all(-1) & ((plain_shares == 0) | (plain_shares > faint)).all(-1)
    assert bool(same.sum() >= 30)
    upstream = [torch.linspace(-1, 1, value.numel(), dtype=dtype).view_as(value) for value in slow]
    found, expected = (torch.autograd.grad(values, raw, upstream)[0] for values in (fast, slow))
    for ours, theirs in zip((*fast, found), (*slow, expected), strict=True):
        ours, theirs = ours[same].detach(), theirs[same].detach()
        scale = float(theirs.abs().max()) + 1
        torch.testing.assert_close(ours, theirs, rtol=0, atol=200 * scale * torch.finfo(dtype).eps)


def test_merging_into_parts_no_larger_than_a_sample_is_no_merging():
    share = torch.full((2, 6), 1 / 6, dtype=torch.float64)
    geometry = torch.arange(48.0, dtype=torch.float64).view(2, 6, 4)
    merged, features, mask = SHADINGS.build("merge", parts=6)(share, geometry)
    torch.testing.assert_close((merged, features), (share, geometry))
    assert bool(mask.all())


def test_merging_follows_the_ray():
    share = torch.tensor([[0.5, 0.25, 0.125, 0.125]], dtype=torch.float64)
    geometry = torch.tensor([[[1.0], [2.0], [4.0], [8.0]]], dtype=torch.float64)
    merged, features, _ = SHADINGS.build("merge", parts=2)(share, geometry)
    torch.testing.assert_close(merged, torch.tensor([[0.5, 0.5]], dtype=torch.float64))
    torch.testing.assert_close(features, torch.tensor([[[1.0], [4.0]]], dtype=torch.float64))


def test_merging_into_parts_that_weigh_enough_has_the_derivatives_of_plain_means():
    share = torch.tensor([[0.3, 0.2, 0.1, 0.4]], dtype=torch.float64, requires_grad=True)
    geometry = torch.tensor([[[1.0], [2.0], [4.0], [8.0]]], dtype=torch.float64)
    shading = SHADINGS.build("merge", parts=2)
    halves = torch.autograd.functional.jacobian(lambda s: shading(s, geometry).geometry, share)
    plain = torch.autograd.functional.jacobian(
        lambda s: (s * geometry[..., 0]).view(1, 2, 2).sum(-1) / s.view(1, 2, 2).sum(-1), share
    )
    torch.testing.assert_close(halves[..., 0, :, :], plain)


def test_a_part_that_weighs_next_to_nothing_has_bounded_derivatives():
    """Behind a normalisation its features get a gradient as large as everybody's."""
    for faint in (1e-6, 1e-20, 1e-38, 0.0):
        share = torch.tensor([[faint, faint / 2, 1.0, faint]], requires_grad=True)
        geometry = torch.tensor([[[1.0], [-2.0], [4.0], [8.0]]], requires_grad=True)
        merged = SHADINGS.build("merge", parts=8)(share, geometry)
        merged.geometry.sum().backward()
        assert share.grad is not None
        assert geometry.grad is not None
        assert float(share.grad.abs().max()) <= 8 / (SMALL / 8)
        assert float(geometry.grad.abs().max()) <= 1 + 1e-6
