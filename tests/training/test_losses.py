import torch

from qnerf.training.losses import (
    distortion,
    interlevel,
)
from qnerf.types import Samples


def histogram(rays: int, bins: int, seed: int, dtype: torch.dtype = torch.float64) -> tuple[Samples, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    s = torch.rand(rays, bins + 1, dtype=dtype, generator=generator).sort(-1).values
    w = torch.rand(rays, bins, dtype=dtype, generator=generator)
    return Samples(1 + 9 * s, s), w / w.sum(-1, keepdim=True)


def test_interlevel_of_a_proposal_without_gradient_and_of_none() -> None:
    samples, weights = histogram(2, 6, 0)
    loss = interlevel(samples, weights, [histogram(2, 4, 1)])
    assert not loss.requires_grad
    assert float(loss.detach()) > 0
    assert float(interlevel(samples, weights, [])) == 0


def test_nan_weights_are_not_hidden() -> None:
    samples, weights = histogram(2, 6, 0)
    outer, proposed = histogram(2, 6, 1)
    broken = weights.clone()
    broken[1, 3] = float("nan")
    assert bool(distortion(samples, broken).isnan())
    assert bool(interlevel(samples, broken, [(outer, proposed)]).isnan())
    assert bool(interlevel(samples, weights, [(outer, proposed * float("nan"))]).isnan())


def test_dtypes_that_are_not_compiled_take_the_reference() -> None:
    samples, weights = histogram(2, 6, 0)
    half = Samples(samples.edges.bfloat16(), samples.spacing.bfloat16())
    assert distortion(half, weights.bfloat16()).dtype == torch.bfloat16
