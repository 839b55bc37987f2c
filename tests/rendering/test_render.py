import math

import pytest
import torch

from qnerf.rendering.render import render, volume_weights
from qnerf.types import Samples


def rays(count, samples, dtype=torch.float64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    s = torch.rand(count, samples + 1, dtype=dtype, generator=generator).sort(-1).values
    density = torch.rand(count, samples, dtype=dtype, generator=generator).mul(8).sub(4).exp()
    return density, Samples(1 + 5 * s, s)


def test_nan_densities_are_not_hidden():
    assert bool(volume_weights(torch.tensor([[1.0, math.nan]]), torch.ones(1, 2)).isnan().any())


@pytest.mark.parametrize("background", ["last_sample", "white", "black"])
def test_opaque_first_sample_and_empty_ray(background):
    density = torch.tensor([[math.inf, 1.0, 1.0], [0.0, 0.0, 0.0]])
    color = torch.tensor([[0.1, 0.2, 0.3], [0.5, 0.5, 0.5], [0.9, 0.8, 0.7]]).expand(2, 3, 3)
    edges = torch.tensor([[1.0, 2.0, 3.0, 5.0]]).expand(2, 4)
    along = Samples(edges, edges)
    rendering, behind = render(volume_weights(density, along.deltas), color, along, background=background)
    empty = {"last_sample": color[0, 2], "white": torch.ones(3), "black": torch.zeros(3)}[background]
    torch.testing.assert_close(rendering.color, torch.stack([color[0, 0], empty]))
    torch.testing.assert_close(rendering.accumulation, torch.tensor([1.0, 0.0]))
    torch.testing.assert_close(rendering.depth, torch.tensor([1.5, 1.5]))
    torch.testing.assert_close(rendering.depth_median, torch.tensor([1.5, 4.0]))
    assert (behind is None) == (background == "last_sample")


def test_random_background_is_the_one_returned():
    density, along = rays(6, 4)
    color = torch.zeros(6, 4, 3, dtype=torch.float64)
    weights = volume_weights(density, along.deltas)
    (first, behind), (again, _) = (
        render(weights, color, along, background="random", generator=torch.Generator().manual_seed(3)) for _ in range(2)
    )
    assert behind.dtype == torch.float64
    torch.testing.assert_close(first.color, (1 - first.accumulation)[:, None] * behind)
    assert torch.equal(first.color, again.color)
    assert len(behind.unique()) == 18


def test_bad_backgrounds_are_refused():
    density, along = rays(2, 3)
    color = torch.rand(2, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match="last_sample, white, black, random, got 'grey'"):
        render(volume_weights(density, along.deltas), color, along, background="grey")
    with pytest.raises(ValueError, match="needs a generator"):
        render(volume_weights(density, along.deltas), color, along, background="random")


@pytest.mark.parametrize("background", ["last_sample", "white"])
def test_rendering_against_a_loop(background):
    density, along = rays(4, 9, seed=5)
    color = torch.rand(4, 9, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    rendering, _ = render(volume_weights(density, along.deltas), color, along, background=background)
    for ray in range(4):
        left, mixed, distance, median = 1.0, torch.zeros(3, dtype=torch.float64), 0.0, None
        for k in range(9):
            weight = left * (1 - math.exp(-float(density[ray, k] * along.deltas[ray, k])))
            mixed += weight * color[ray, k]
            distance += weight * float(along.mids[ray, k])
            left -= weight
            if median is None and left <= 0.5:
                median = float(along.mids[ray, k])
        mixed += left * (color[ray, -1] if background == "last_sample" else 1.0)
        torch.testing.assert_close(rendering.color[ray], mixed)
        assert float(rendering.accumulation[ray]) == pytest.approx(1 - left)
        assert float(rendering.depth[ray]) == pytest.approx(distance / (1 - left))
        assert float(rendering.depth_median[ray]) == (median if median is not None else float(along.mids[ray, -1]))
