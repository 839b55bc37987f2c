"""Volume rendering on the inputs at which float32 gives up."""

import copy
import math

import numpy as np
import pytest
import torch
from hypothesis import given, target
from hypothesis import strategies as st

from benchmarks.accuracy_cases import EPS, rounded
from benchmarks.accuracy_cases.rendering import PIXELS, WEIGHT_GRADIENTS, WEIGHTS, SmallField
from qnerf.config.settings import BACKGROUNDS
from qnerf.heads.activations import trunc_exp
from qnerf.rendering.render import render, volume_weights, volume_weights_reference
from qnerf.types import Samples
from tests.helpers.hard_inputs import TINY, distance, seeds

PARAMETER_GRADIENTS = 1e-4
"""Of a field's parameters, each tensor relative to its largest: what is asked for."""
RAY_GRADIENTS = {"origins": 2e-3, "directions": 2e-3}
"""Of rays through a hash grid. Float32 points are right to about 3 EPS, 7e-4 of a cell where 2,048 lie on a side; on
each of three axes the slope changes from one side of a cell to the other by as much as itself."""

SIGMAS = st.sampled_from([0.0, 1e-38, 1e-30, 1.0, 1e10, 1e38, math.inf]) | st.floats(0, 200, width=32)
DELTAS = st.sampled_from([0.0, 1.0]) | st.floats(2**-20, 2, width=32)
INTERVALS = st.lists(st.tuples(SIGMAS, DELTAS, st.floats(-1, 1, width=32)), min_size=1, max_size=24)


def exactly(sigma, delta, upstream):
    """Weights, the transmittance behind each, d(upstream . weights)/d sigma by steps of 1e-40 i: no digit cancels."""

    def weights(x):
        behind = np.exp(-np.cumsum(x))
        return -np.expm1(-x) * np.concatenate([[1.0], behind[:-1]]), behind

    thickness = np.minimum(sigma, 1e30) * delta  # infinite ones too are opaque
    found, behind = weights(thickness)
    gradient = np.zeros(len(sigma))
    for i in range(len(sigma)):
        moved = thickness.astype(complex)
        moved[i] += 1e-40j * delta[i]
        gradient[i] = (upstream * weights(moved)[0].imag).sum() / 1e-40
    return found, behind, gradient


def check(sigma, delta, upstream):
    """Asserts the bounds on one ray (K,); the gradient's error in its bound's unit."""
    expected, behind, slope = exactly(sigma.numpy(), delta.numpy(), upstream.numpy())
    leaf = sigma.float()[None].requires_grad_()
    weights = volume_weights(leaf, delta.float()[None])
    (gradient,) = torch.autograd.grad(weights, leaf, upstream.float()[None])
    found = weights[0].detach().double()
    assert float(found.sum()) <= 1 + (len(sigma) + 4) * EPS
    assert distance(found, torch.from_numpy(expected)) <= WEIGHTS * expected.max() + TINY
    error = np.abs(gradient[0].double().numpy() - slope)
    unit = EPS * delta.numpy() * (behind * np.abs(upstream.numpy()).max() + len(sigma) * TINY / EPS)
    worst = float(np.max(error / np.where(unit > 0, unit, 1)))
    assert worst <= WEIGHT_GRADIENTS / EPS
    return worst


@given(ray=INTERVALS)
def test_weights_and_gradients_of_the_worst_ray(ray):
    sigma, delta, upstream = (rounded(column) for column in zip(*ray, strict=True))
    target(check(sigma, delta, upstream))


@pytest.mark.parametrize("function", [volume_weights, volume_weights_reference])
def test_gradients_behind_an_opaque_first_sample_keep_their_digits(function):
    """The transmittance behind is 1e-13: any difference of numbers near 1 has no digit of it."""
    sigma, delta = rounded([30.0, 1.0, 2.0]), rounded([1.0, 0.3, 0.2])
    upstream = rounded([0.5, -0.25, 1.0])
    leaf = sigma[None].float().requires_grad_()
    (gradient,) = torch.autograd.grad(function(leaf, delta[None].float()), leaf, upstream[None].float())
    exact = torch.from_numpy(exactly(sigma.numpy(), delta.numpy(), upstream.numpy())[2])
    torch.testing.assert_close(gradient[0].double(), exact, rtol=1e-4, atol=0)


def test_sigma_that_overflows_in_exp_has_a_finite_gradient():
    raw = torch.tensor([[1.0, 200.0, -200.0, 2.0]], requires_grad=True)
    sigma = trunc_exp(raw)
    assert sigma.isinf().tolist() == [[False, True, False, False]]
    weights = volume_weights(sigma, torch.full((1, 4), 0.1))
    (weights * torch.tensor([1.0, -1.0, 2.0, 0.5])).sum().backward()
    assert bool(raw.grad.isfinite().all())
    assert float(raw.grad[0, 0]) != 0


@given(ray=INTERVALS, background=st.sampled_from([name for name in BACKGROUNDS if name != "random"]), seed=seeds)
def test_pixels_of_the_worst_ray(ray, background, seed):
    """The same densities and colours; depth and opacity within as much of what they are measured in."""
    sigma, delta, _ = (rounded(column)[None] for column in zip(*ray, strict=True))
    edges = rounded(torch.nn.functional.pad(delta.cumsum(-1), (1, 0)))
    colors = rounded(torch.rand(1, len(ray), 3, generator=torch.Generator().manual_seed(seed)))
    found = []
    for dtype in (torch.float32, torch.float64):
        samples = Samples(edges.to(dtype), edges.to(dtype))
        weights = volume_weights(sigma.to(dtype), samples.deltas)
        found.append(render(weights, colors.to(dtype), samples, background=background)[0])
    error = distance(found[0].color, found[1].color)
    target(error)
    assert error <= PIXELS
    assert distance(found[0].accumulation, found[1].accumulation) <= PIXELS
    for rendering in found:
        assert bool((rendering.depth >= rendering.depth.new_tensor(0)).all())
        assert bool((rendering.depth <= edges.max()).all())


FIELDS = {
    "none": {},
    "pe": {},
    "rff": {"scale": 4},
    "hash": {"levels": 16, "max_resolution": 2048, "log2_table_size": 10, "features": 2},
}
RAYS = 8


@pytest.fixture(scope="module")
def fields():
    singles = {name: SmallField(name, RAYS, **options) for name, options in FIELDS.items()}
    return {name: (single, copy.deepcopy(single).double()) for name, single in singles.items()}


@pytest.mark.parametrize("encoder", FIELDS)
def test_gradients_of_a_field_s_parameters_and_of_its_rays(fields, encoder):
    edges = rounded(0.05 + 4 * torch.rand(RAYS, 25, generator=torch.Generator().manual_seed(0)).sort(-1).values ** 2)
    found = []
    for field in fields[encoder]:
        dtype = field.origins.dtype
        loss = field(edges.to(dtype)).square().mean()
        found.append(torch.autograd.grad(loss, [parameter for _, parameter in field.named_parameters()]))
    for (name, _), a, b in zip(fields[encoder][0].named_parameters(), *found, strict=True):
        bound = RAY_GRADIENTS.get(name, PARAMETER_GRADIENTS) if encoder == "hash" else PARAMETER_GRADIENTS
        assert distance(a, b) <= bound * float(b.abs().max()), name
