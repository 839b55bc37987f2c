import math

import pytest
import torch

from qnerf.heads.activations import COLOR_ACTIVATIONS, DENSITY_ACTIVATIONS, softplus, trunc_exp


def test_known_names() -> None:
    assert DENSITY_ACTIVATIONS.names() == ["softplus", "trunc_exp"]
    with pytest.raises(ValueError, match="known: softplus, trunc_exp"):
        DENSITY_ACTIVATIONS.get("relu")


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


def test_color_activations_have_their_values_and_slopes_at_0() -> None:
    assert COLOR_ACTIVATIONS.names() == ["linear", "scaled", "sigmoid"]
    for name, value, slope in (("sigmoid", 0.5, 0.25), ("linear", 0.0, 1.0), ("scaled", 0.5, 1.0)):
        x = torch.zeros(1, dtype=torch.float64, requires_grad=True)
        y = COLOR_ACTIVATIONS.get(name)(x)
        y.backward()
        assert x.grad is not None
        assert (float(y.detach()), float(x.grad)) == (value, slope), name


@pytest.mark.parametrize("name", COLOR_ACTIVATIONS.names())
def test_gradients_of_color_activations(name: str) -> None:
    x = torch.linspace(-3, 3, 7, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(COLOR_ACTIVATIONS.get(name), x)
    assert torch.autograd.gradgradcheck(COLOR_ACTIVATIONS.get(name), x)
    extreme = torch.tensor([-1e4, 1e4], requires_grad=True)
    COLOR_ACTIVATIONS.get(name)(extreme).sum().backward()
    assert extreme.grad is not None
    assert bool(extreme.grad.isfinite().all())
