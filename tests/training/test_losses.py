import dataclasses

import pytest
import torch

from qnerf.building.model import ray_table
from qnerf.training.losses import distortion, interlevel, sparse_depth
from qnerf.training.terms import LOSSES
from qnerf.training.trainer import Trainer
from qnerf.types import Samples
from tests.helpers.trainer import built, trainer


def histogram(rays, bins, seed, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    s = torch.rand(rays, bins + 1, dtype=dtype, generator=generator).sort(-1).values
    w = torch.rand(rays, bins, dtype=dtype, generator=generator)
    return Samples(1 + 9 * s, s), w / w.sum(-1, keepdim=True)


def test_interlevel_of_a_proposal_without_gradient_and_of_none():
    samples, weights = histogram(2, 6, 0)
    loss = interlevel(samples, weights, [histogram(2, 4, 1)])
    assert not loss.requires_grad
    assert float(loss.detach()) > 0
    assert float(interlevel(samples, weights, [])) == 0


def test_nan_weights_are_not_hidden():
    samples, weights = histogram(2, 6, 0)
    outer, proposed = histogram(2, 6, 1)
    broken = weights.clone()
    broken[1, 3] = float("nan")
    assert bool(distortion(samples, broken).isnan())
    assert bool(interlevel(samples, broken, [(outer, proposed)]).isnan())
    assert bool(interlevel(samples, weights, [(outer, proposed * float("nan"))]).isnan())


def test_dtypes_that_are_not_compiled_take_the_reference():
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
    with pytest.raises(
        ValueError, match="unknown name 'opacety'; known: distortion, interlevel, mse, poses, sparse_depth"
    ):
        trainer(tiny("field=classical", "train.losses={opacety: 1}"))


def test_sparse_depth_is_least_where_a_ray_ends_at_its_point():
    edges = torch.linspace(0.5, 4.5, 41, dtype=torch.float64).expand(3, -1)
    ends = torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64)
    weights = torch.eye(40, dtype=torch.float64)[[5, 15, 35]]  # in [1.0, 1.1], [2.0, 2.1] and [4.0, 4.1]
    found = [float(sparse_depth(edges, weights, ends + shift)) for shift in (-0.3, 0.05, 0.3)]
    assert found[1] < 1 < 5 < min(found[0], found[2])


SPARSE = ("train.losses={sparse_depth: 0.1, mse: 0}", "train.rays=256", "train.steps=40", "train.lr=0.003")


def test_sparse_points_pull_density_to_them_and_a_scene_without_them_is_refused(tiny):
    settings, scene, model, table, watch = built(tiny("field=classical", *SPARSE))
    with pytest.raises(
        ValueError, match=r"nerfstudio has no sparse points; scene=colmap reads them with scene\.points=true"
    ):
        Trainer(model, table, settings, watch)
    views = torch.arange(len(scene.cameras))[:, None]
    ahead = scene.cameras.poses[:, :, 3] - scene.cameras.poses[:, :, 2]
    points = dataclasses.replace(scene, points=torch.cat([views, ahead], 1))
    taken = Trainer(model, ray_table(settings, points), settings, watch)
    found = [taken.take_step(measure=True)["train/sparse_depth"] for _ in range(40)]
    assert sum(found[-5:]) < 0.6 * sum(found[:5])
