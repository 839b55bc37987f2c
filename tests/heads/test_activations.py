import math

import pytest
import torch

from qnerf.heads.activations import ACTIVATIONS, softplus, trunc_exp


def test_known_names() -> None:
    assert ACTIVATIONS.names() == ["softplus", "trunc_exp"]
    with pytest.raises(ValueError, match="known: softplus, trunc_exp"):
        ACTIVATIONS.get("relu")


def test_trunc_exp_is_exp_with_a_clamped_derivative() -> None:
    x = torch.tensor([-800.0, -100.0, -15.0, 0.0, 3.0, 15.0, 60.0, 800.0], dtype=torch.float64, requires_grad=True)
    y = trunc_exp(x)
    assert torch.equal(y, x.exp())
    y.sum().backward()
    assert x.grad is not None
    torch.testing.assert_close(x.grad, x.detach().clamp(-15, 15).exp())


def test_trunc_exp_gradient_within_the_clamp() -> None:
    x = torch.linspace(-5, 5, 7, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(trunc_exp, x)


def test_trunc_exp_keeps_nan() -> None:
    assert math.isnan(float(trunc_exp(torch.tensor(math.nan))))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_softplus_against_logaddexp(dtype: torch.dtype) -> None:
    x = torch.tensor([-1000.0, -50.0, -1.0, 0.0, 1.0, 19.0, 21.0, 39.0, 41.0, 1000.0], dtype=dtype, requires_grad=True)
    y = softplus(x)
    eps = torch.finfo(dtype).eps
    torch.testing.assert_close(y, torch.logaddexp(x, torch.zeros_like(x)), rtol=4 * eps, atol=0)
    y.sum().backward()
    assert x.grad is not None
    torch.testing.assert_close(x.grad, torch.sigmoid(x.detach()), rtol=4 * eps, atol=eps)
