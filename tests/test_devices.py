"""Nothing mixes the CPU with another device, as far as a machine without one can tell; a GPU computes the same."""

import subprocess
import sys

import pytest
import torch
from torch.utils import backend_registration

from qnerf.model import chosen_rows
from tests.helpers.configs import ROOT, TINY, composed
from tests.helpers.trainer import trainer

SCENE = ("scene=poster", "scene.views=6")


def test_the_layer_and_a_training_step_stay_on_their_device():
    if not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"):
        pytest.skip("this PyTorch cannot register a device from Python")
    fields = [
        "field=classical",
        "field=classical train.error_rays=0.5",
        "field=qboth",
        "field=qcolor qiren.statistics=first",
    ]
    command = [sys.executable, "-m", "tests.helpers.fake_accelerator", *fields]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    lines = done.stdout.split("\n")
    steps = {f"{options} 10" for options in fields}
    assert {"qiren 2 0.1", "lightcone", *steps, "done"} <= set(lines), done.stderr[-2000:]


@pytest.mark.parametrize(
    "options",
    [("field=qcolor",), ("field=qboth",), ("field=qcolor", "shading=none"), ("field=qboth", "qiren.statistics=first")],
)
def test_a_step_of_fixed_shapes_computes_what_one_that_gathers_rows_does(options, monkeypatch):
    gathered = loss_and_gradients("cpu", *options)
    monkeypatch.setattr(chosen_rows, "gathers", lambda mask: False)
    for fixed, own in zip(loss_and_gradients("cpu", *options), gathered, strict=True):
        torch.testing.assert_close(fixed, own, rtol=1e-9, atol=1e-11)


def test_only_a_measured_step_waits_for_the_device(monkeypatch):
    taken = trainer(composed(*SCENE, *TINY, "field=classical", "hash=C7", "train.rays=8", "device=cpu"))
    taken.watch.device = torch.device("cuda")
    waits = []
    monkeypatch.setattr(torch.accelerator, "synchronize", waits.append)
    assert taken.take_step(False) == {}
    assert not waits
    assert taken.take_step(True)["train/loss"] > 0
    assert waits


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("field", ["classical", "qcolor", "qdensity", "qboth"])
def test_a_gpu_has_the_loss_and_gradients_of_the_cpu(field):
    here = loss_and_gradients("cpu", f"field={field}")
    for there, own in zip(loss_and_gradients("cuda", f"field={field}"), here, strict=True):
        torch.testing.assert_close(there, own, rtol=1e-6, atol=1e-9)


def loss_and_gradients(device, *options):
    """Of a step in float64 without jitter, on the CPU; the statistics of normalisations come last."""
    config = composed(
        "scene=poster", "scene.views=6", *TINY, *options, "hash=C7", "numerics.dtype=float64", f"device={device}"
    )
    taken = trainer(config)
    model = taken.model
    rays, pixels = taken.table.batch(taken.table.draw(64, torch.Generator().manual_seed(0)), model.cameras)
    rendering, sampled, _ = model(rays, background="last_sample", step=0, watch=taken.watch)
    loss = torch.stack(list(taken.loss_terms(rendering, sampled, pixels[..., :3]).values())).sum()
    loss.backward()
    gradients = [p.grad for p in model.parameters() if p.grad is not None]
    statistics = [value for name, value in model.named_buffers() if "running" in name]
    return [value.detach().cpu() for value in (loss, *gradients, *statistics)]
