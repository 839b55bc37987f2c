"""The normalisation before each circuit on hard cases: few rows, no variance, huge offsets, lagging statistics."""

from itertools import product

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from benchmarks.accuracy_cases import EPS
from benchmarks.accuracy_cases.circuits import NORMALISED, normalisation_plain
from qnerf.heads import HEADS, HybridLayer
from qnerf.quantum import QuantumLayer

DAMPING = 1e-5  # added to the variance


class Angles(torch.nn.Module):
    """Stands where the circuit does, and gives the angles that it would get."""

    wires = 3

    def forward(self, angles):
        return angles


def layer(in_dim=3, dtype=torch.float32):
    """Its linear map is the identity."""
    made = HybridLayer(in_dim, 3, Angles()).to(dtype)
    torch.nn.init.eye_(made.linear.weight)
    torch.nn.init.zeros_(made.linear.bias)
    return made


def features(rows, offset=0.0, spread=1.0, seed=0):
    return torch.randn(rows, 3, generator=torch.Generator().manual_seed(seed)) * spread + offset


def test_batches_of_1_are_refused_in_training_and_evaluated_as_in_any_other():
    head = HEADS.build("qiren", 4, 3, layers=1, spectral=1, qubits=3)
    for rows in (0, 1):
        with pytest.raises(ValueError, match=f"expected at least 2, got {rows}; raise train.rays") as caught:
            head(torch.zeros(rows, 4))
        assert "\n" not in str(caught.value)
    for _ in range(5):
        head(torch.randn(32, 4))
    head.eval()
    x = torch.randn(8, 4)
    alone = torch.cat([head(row[None]) for row in x])
    assert (alone - head(x)).abs().max() <= 100 * EPS  # other engines and matrix products for other batches
    assert head(x[:0]).shape == (0, 3)


def test_batches_of_2_give_plus_and_minus_1_whatever_the_features_are():
    angles = layer()(torch.tensor([[1.0, 5.0, -100.0], [2.0, 4.0, 900.0]]))
    expected = torch.tensor([[-1.0, 1.0, -1.0], [1.0, -1.0, 1.0]])
    assert (angles - expected).abs().max() <= DAMPING / 0.25  # the least variance is 1/4; 1 / sqrt(1 + 4e-5)


def test_constant_features_give_the_bias():
    for rows, value in product((2, 6144), (0.0, 0.1, 1000.1, -3e7)):
        made = layer()
        torch.nn.init.constant_(made.norm.bias, 0.25)
        x = features(rows)
        x[:, 1] = value
        x.requires_grad_()
        angles = made(x)
        assert (angles[:, 1] - 0.25).abs().max() <= NORMALISED
        (gradient,) = torch.autograd.grad(angles.square().sum(), x)
        assert torch.isfinite(gradient).all()
        assert made.norm.running_var[1] <= 0.9 * (1 + EPS)  # it was 1, and saw none


@settings(max_examples=60)
@given(
    rows=st.integers(3, 400),
    offset=st.floats(-1e6, 1e6),
    spread=st.floats(1e-4, 1e4),
    seed=st.integers(0, 2**31),
)
@example(rows=64, offset=1e6, spread=1e-4, seed=0)
@example(rows=3, offset=0.0, spread=1e4, seed=1)
def test_huge_offset_with_small_variance_costs_no_digit(rows, offset, spread, seed):
    """Beyond those that rounding the features themselves has cost."""
    x = features(rows, offset, spread, seed)
    expected = normalisation_plain(x.double(), torch.ones(3).double(), torch.zeros(3).double())
    bound = NORMALISED * max(1.0, float(expected.abs().max()))
    assert (layer()(x) - expected).abs().max() <= bound


def test_linear_bias_that_the_normalisation_cancels_has_no_gradient_in_training():
    made = HybridLayer(3, 3, QuantumLayer(3, 1))
    x = features(50)
    made(x).square().sum().backward()
    assert not made.linear.bias.grad.any()
    made.linear.bias.grad = None
    made.eval()(x).square().sum().backward()
    assert made.linear.bias.grad.all()


def test_features_whose_variance_overflows_give_finite_angles():
    """Beyond 3e38 / rows for their squares, every angle is the bias: constant, but no NaN up to 3e38 / rows."""
    for size in (1e16, 1e20, 1e36):
        made = layer()
        x = features(64, spread=size / 4).requires_grad_()
        angles = made(x)
        assert torch.isfinite(angles).all()
        assert torch.isfinite(torch.autograd.grad(angles.square().sum(), x)[0]).all()
        assert (angles.abs().max() > 1) == (size < 1e18)
