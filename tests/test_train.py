import pytest
import torch

from qnerf.config import settings_from
from qnerf.experiment import build_model, build_scene, ray_table
from qnerf.quantum import QuantumLayer
from qnerf.timing import PARTS, Stopwatch, median_ms
from qnerf.train import Trainer, composite, learning_rate


def trainer(config) -> Trainer:
    settings = settings_from(config)
    scene = build_scene(settings)
    model = build_model(settings, scene)
    watch = Stopwatch(settings.torch_device, model, QuantumLayer)
    return Trainer(model, ray_table(settings, scene), settings, watch)


def test_the_learning_rate_decays_exponentially_from_first_to_last(tiny):
    train = settings_from(tiny("train=paper", "train.steps=30000")).train
    assert learning_rate(0, train) == pytest.approx(1e-2)
    assert learning_rate(15000, train) == pytest.approx(1e-3)
    assert learning_rate(30000, train) == pytest.approx(1e-4)


def test_the_paper_recipe_is_the_papers(config):
    settings = settings_from(config("train=paper", "field=qcolor", "qiren=1L2S"))
    train = settings.train
    assert (train.steps, train.rays, train.lr, train.lr_final, train.eps) == (30000, 128, 1e-2, 1e-4, 1e-15)
    assert (train.interlevel, train.distortion) == (1.0, 0.002)
    sampler = settings.sampler
    assert (sampler["samples"], sampler["final"], sampler["update_every"]) == ([256, 96], 48, 5)
    assert (sampler["anneal_steps"], sampler["anneal_slope"], sampler["log2_table_size"]) == (1000, 10.0, 17)
    assert sampler["max_resolutions"] == [128, 256]
    assert (settings.render.near, settings.render.far) == (0.05, 1000)
    assert settings.visibility.cameras == 0
    head = settings.color["qiren"]
    assert (head["init"], head["gain"], head["sum_layers"], head["input_scale"]) == ("uniform", 1.0, False, 1.0)
    assert head["center"] is False
    assert (settings.density["activation"], settings.contraction["name"]) == ("trunc_exp", "linf")


def test_configurations_of_one_seed_see_the_same_batches(tiny):
    drawn = []
    for overrides in (["field=classical"], ["field=qboth", "sampler=uniform", "sampler.samples=5"]):
        taken = trainer(tiny(*overrides))
        taken.take_step(measure=False)
        rays, _ = taken.table.batch(8, taken.streams["pixels"])
        drawn.append((rays.cameras, rays.directions))
    assert torch.equal(drawn[0][0], drawn[1][0])
    assert torch.equal(drawn[0][1], drawn[1][1])


def test_a_measured_step_reports_its_parts(tiny):
    metrics = trainer(tiny("field=qcolor", "cameras=so3xr3")).take_step(measure=True)
    assert {f"time/{part}_ms" for part in PARTS} <= set(metrics)
    parts = ("mse", "interlevel", "distortion", "poses")
    assert metrics["train/loss"] == pytest.approx(sum(metrics[f"train/{name}"] for name in parts), rel=1e-5)
    assert 0 < metrics["time/quantum_ms"] <= metrics["time/field_ms"]


def test_steps_lower_the_loss(tiny):
    taken = trainer(tiny("field=qcolor", "train.steps=60", "train.rays=64"))
    losses = [taken.take_step(measure=True)["train/mse"] for _ in range(60)]
    assert sum(losses[-10:]) < 0.9 * sum(losses[:10])


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_parameters_and_gradients_stay_in_their_dtype(tiny, dtype):
    taken = trainer(tiny("field=qboth", f"numerics.dtype={dtype}"))
    taken.take_step(measure=False)
    assert {p.dtype for p in taken.model.parameters()} == {getattr(torch, dtype)}
    assert {p.grad.dtype for p in taken.model.parameters() if p.grad is not None} == {getattr(torch, dtype)}


def test_alpha_is_composited_on_what_lies_behind():
    pixels = torch.tensor([[0.2, 0.4, 0.6, 0.5]])
    behind = torch.tensor([[1.0, 0.0, 0.5]])
    torch.testing.assert_close(composite(pixels, behind), torch.tensor([[0.6, 0.2, 0.55]]))
    assert torch.equal(composite(pixels[:, :3], None), pixels[:, :3])


def test_the_median_leaves_the_first_fifty_steps_out():
    assert median_ms([9.0] * 50 + [1.0, 2.0, 3.0]) == 2000
    assert median_ms([1.0, 3.0, 2.0]) == 2000
