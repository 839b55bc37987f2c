"""The maps from raw outputs to densities and colours."""

import torch

from qnerf.heads.activations import COLOR_ACTIVATIONS, softplus, trunc_exp


def test_trunc_exp_is_exp_with_a_clamped_derivative():
    x = torch.tensor([-800.0, -100.0, -15.0, 0.0, 3.0, 15.0, 60.0, 800.0], dtype=torch.float64, requires_grad=True)
    y = trunc_exp(x)
    assert torch.equal(y, x.exp())
    y.sum().backward()
    torch.testing.assert_close(x.grad, x.detach().clamp(-15, 15).exp())
    assert torch.autograd.gradcheck(trunc_exp, torch.linspace(-5, 5, 7, dtype=torch.float64, requires_grad=True))
    assert bool(trunc_exp(torch.tensor(torch.nan)).isnan())


def test_softplus_is_logaddexp():
    for dtype in (torch.float32, torch.float64):
        x = torch.tensor([-1000.0, -50.0, -1.0, 0.0, 19.0, 21.0, 39.0, 41.0, 1000.0], dtype=dtype, requires_grad=True)
        y = softplus(x)
        eps = torch.finfo(dtype).eps
        torch.testing.assert_close(y, torch.logaddexp(x, torch.zeros_like(x)), rtol=4 * eps, atol=0)
        y.sum().backward()
        assert x.grad is not None
        torch.testing.assert_close(x.grad, torch.sigmoid(x.detach()), rtol=4 * eps, atol=eps)


def test_color_activations_have_their_values_slopes_and_gradients():
    for name, value, slope in (("sigmoid", 0.5, 0.25), ("linear", 0.0, 1.0), ("scaled", 0.5, 1.0)):
        activation = COLOR_ACTIVATIONS.get(name)
        x = torch.zeros(1, dtype=torch.float64, requires_grad=True)
        y = activation(x)
        y.backward()
        assert x.grad is not None
        assert (float(y.detach()), float(x.grad)) == (value, slope), name
        x = torch.linspace(-3, 3, 7, dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(activation, x)
        assert torch.autograd.gradgradcheck(activation, x)
        extreme = torch.tensor([-1e4, 1e4], requires_grad=True)
        activation(extreme).sum().backward()
        assert extreme.grad is not None
        assert bool(extreme.grad.isfinite().all()), name
