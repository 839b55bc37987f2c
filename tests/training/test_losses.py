import pytest
import torch

from qnerf.training.losses import (
    distortion,
    interlevel,
)
from qnerf.training.terms import LOSSES
from qnerf.types import Samples
from tests.helpers.trainer import trainer


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


def test_a_registered_term_trains_from_the_step_in_which_it_acts(tiny, monkeypatch):
    monkeypatch.setitem(LOSSES._components, "bright", lambda step: step.rendering.color.mean() if step.number else None)
    config = ("field=classical", "train.rays=40", "train.steps=9")
    plain, more = trainer(tiny(*config)), trainer(tiny(*config, "train.losses={bright: 5.0}"))
    assert plain.take_step(measure=True)["train/loss"] == more.take_step(measure=True)["train/loss"]
    expected, found = plain.take_step(measure=True), more.take_step(measure=True)
    assert found["train/mse"] == expected["train/mse"]
    assert found["train/loss"] == pytest.approx(
        found["train/mse"] + found["train/bright"] + found["train/distortion"] + found["train/interlevel"]
    )
    one, other = (torch.cat([part.flatten() for part in taken.model.parameters()]) for taken in (plain, more))
    assert not torch.equal(one, other)


def test_a_built_in_term_can_be_taken_out_and_an_unknown_one_is_named(tiny):
    without = trainer(tiny("field=classical", "train.losses={distortion: 0}")).take_step(measure=True)
    assert "train/mse" in without
    assert "train/distortion" not in without
    with pytest.raises(ValueError, match="unknown name 'opacety'; known: distortion, interlevel, mse, poses"):
        trainer(tiny("field=classical", "train.losses={opacety: 1}"))
