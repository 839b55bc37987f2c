"""Nothing mixes the CPU with another device, as far as a machine without one can tell; a GPU computes the same."""

import subprocess
import sys

import pytest
import torch
from torch import Tensor
from torch.utils import backend_registration

from tests.helpers.configs import ROOT, TINY, composed
from tests.helpers.trainer import trainer


def test_the_layer_and_a_training_step_stay_on_their_device() -> None:
    if not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"):
        pytest.skip("this PyTorch cannot register a device from Python")
    command = [sys.executable, "-m", "tests.helpers.fake_accelerator", "qcolor"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    lines = done.stdout.split("\n")
    assert {"qiren 2 0.1", "lightcone", "qcolor", "done"} <= set(lines), done.stderr[-2000:]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("field", ["classical", "qcolor", "qdensity", "qboth"])
def test_a_gpu_has_the_loss_and_gradients_of_the_cpu(field: str) -> None:
    loss, gradients = loss_and_gradients(field, "cpu")
    loss_there, gradients_there = loss_and_gradients(field, "cuda")
    torch.testing.assert_close(loss_there, loss, rtol=1e-9, atol=1e-12)
    for there, here in zip(gradients_there, gradients, strict=True):
        torch.testing.assert_close(there, here, rtol=1e-6, atol=1e-9)


def loss_and_gradients(field: str, device: str) -> tuple[Tensor, list[Tensor]]:
    """Of a step in float64 without jitter, on the CPU."""
    config = composed("scene=poster", *TINY, f"field={field}", "hash=C7", "numerics.dtype=float64", f"device={device}")
    taken = trainer(config)
    model = taken.model
    rays, pixels = taken.table.batch(64, torch.Generator().manual_seed(0), model.cameras)
    rendering, sampled, _ = model(rays, background="last_sample", step=0, watch=taken.watch)
    loss = torch.stack(list(taken.loss_terms(rendering, sampled, pixels[..., :3]).values())).sum()
    loss.backward()
    return loss.detach().cpu(), [p.grad.cpu() for p in model.parameters() if p.grad is not None]
