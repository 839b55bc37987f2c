"""Pixels and their squared errors in one loop against plain PyTorch: kernels/compositing.py."""

import numpy as np
import pytest
import torch

from qnerf.kernels.compositing import composite
from qnerf.kernels.jit import prepared
from qnerf.rendering.render import render
from qnerf.scenes.base import composite as over
from qnerf.training.losses import mse
from qnerf.types import Samples


@pytest.mark.parametrize(("channels", "background"), [(3, "last_sample"), (3, "black"), (4, "white")])
def test_error_and_gradients_are_those_of_plain_pytorch(channels, background):
    """With points that have no colour, a ray without any, and one whose weights sum to more than 1 by rounding."""
    rays, points, samples = 5, 3, 6
    generator = torch.Generator().manual_seed(channels)
    draw = {"generator": generator, "dtype": torch.float64}
    weights = torch.rand(rays, samples, **draw) / samples
    weights[2] = torch.tensor([1.0, 1e-12, 0, 0, 0, 0])
    chosen = torch.rand(rays, points, generator=generator) < 0.6
    chosen[1] = False
    shares = torch.rand(rays, points, **draw) * chosen
    colors, pixels = torch.rand(int(chosen.sum()), 3, **draw), torch.rand(rays, channels, **draw)
    leaves = [one.requires_grad_() for one in (colors, shares, weights)]

    full = torch.zeros(rays, points, 3, dtype=torch.float64).masked_scatter(chosen[..., None], colors)
    edges = torch.linspace(0, 1, samples + 1, dtype=torch.float64).expand(rays, -1)
    rendering, behind = render(weights, full, Samples(edges, edges), background=background, shares=shares)
    loss = mse(rendering.color, over(pixels, behind))
    expected = torch.autograd.grad(loss, leaves, materialize_grads=True)

    squares, found = np.empty(rays), [torch.full_like(one, torch.nan) for one in leaves]
    ends = np.cumsum(np.count_nonzero(chosen.numpy(), axis=1))
    behind = torch.empty(0, dtype=torch.float64) if behind is None else behind
    arrays = (shares, weights, chosen, ends, pixels, behind, squares, *found, colors)
    prepared(composite, rays, points, samples, *arrays)()
    assert squares.sum() / (3 * rays) == pytest.approx(float(loss.detach()), rel=1e-12)
    for ours, theirs, where in zip(found, expected, (None, chosen, None), strict=True):
        torch.testing.assert_close(ours if where is None else ours[where], theirs if where is None else theirs[where])
