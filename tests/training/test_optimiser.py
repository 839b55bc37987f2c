"""Adam in a compiled loop against PyTorch's: training/optimiser.py."""

import pytest
import torch
from torch import nn

from qnerf.config.settings import Fit, SignalRates
from qnerf.kernels import plain
from qnerf.training.optimiser import apply_gradients, build_optimiser, forget_gradients

TRAIN = Fit(rates=SignalRates(), steps=6, lr=1e-2, lr_final=1e-2, eps=1e-15, points=1, betas=[0.8, 0.99])


def trained(dtype: torch.dtype, steps: int) -> tuple[list[nn.Parameter], torch.optim.Optimizer]:
    """Parameters of two rates of which the last one gets no gradient at first."""
    generator = torch.Generator().manual_seed(0)
    shapes = ((1000, 3), (7,), (5, 4))
    parameters = [nn.Parameter(torch.randn(shape, generator=generator, dtype=dtype)) for shape in shapes]
    groups = [{"params": parameters[:1], "name": "a"}, {"params": parameters[1:], "name": "b"}]
    optimiser = build_optimiser(groups, TRAIN)
    optimiser.param_groups[1]["lr"] = 3e-3
    for step in range(steps):
        for parameter in parameters[: 2 if step < 2 else 3]:
            parameter.grad = torch.randn(parameter.shape, generator=generator, dtype=dtype)
        apply_gradients(optimiser)
        forget_gradients(optimiser)
        assert all(parameter.grad is None for parameter in parameters)
    return parameters, optimiser


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_adam_of_the_loop_is_pytorchs(dtype):
    ours, optimiser = trained(dtype, steps=6)
    with plain():
        theirs, reference = trained(dtype, steps=6)
    near = {"rtol": 0, "atol": 20 * torch.finfo(dtype).eps}
    torch.testing.assert_close(ours, theirs, **near)
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(optimiser.state[one], reference.state[other], **near)


def test_apply_gradients_steps_any_other_optimiser():
    parameter = nn.Parameter(torch.ones(2))
    parameter.grad = torch.ones(2)
    apply_gradients(torch.optim.SGD([parameter], lr=0.25))
    assert parameter.tolist() == [0.75, 0.75]
