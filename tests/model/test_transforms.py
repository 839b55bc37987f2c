"""The whole model under forward-mode differentiation and torch.func: the derivatives are those of the backward pass."""

import pytest
import torch
from torch.autograd import forward_ad
from torch.func import functional_call, jvp

from qnerf.geometry.contraction import CONTRACTIONS, Box
from qnerf.geometry.unit_points import unit_points
from qnerf.types import Rays, Samples
from tests.helpers.trainer import built

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated")  # PyTorch's own, for derivatives

MODELS = {
    "MLPs": ["field=classical"],
    "circuits": ["field=qboth"],
    "amplitudes, merged": ["field=classical", "density=amplitude", "shading=merge"],
    "Fourier features, masked": ["field=qcolor", "color=qfgn", "visibility.cameras=2"],
}


@pytest.mark.parametrize("name", MODELS)
def test_the_rendered_colours_along_a_direction_of_all_parameters(tiny, name):
    _, _, model, table, watch = built(tiny("numerics.dtype=float64", *MODELS[name]))
    model.eval()
    rays = table.view(0)[torch.arange(0, len(table.view(0)), 9)]

    def color(parameters):
        rendering, _, _ = functional_call(
            model, parameters, (rays,), {"background": "white", "step": 3, "watch": watch}
        )
        return rendering.color

    at = {name: parameter.detach().clone() for name, parameter in model.named_parameters()}
    direction = {name: torch.randn_like(value) for name, value in at.items()}
    value, tangent = jvp(color, (at,), (direction,))
    leaves = {name: value.requires_grad_() for name, value in at.items()}
    expected = color(leaves)
    torch.testing.assert_close(value, expected, rtol=1e-10, atol=1e-12)
    cotangent = torch.randn_like(expected)
    gradients = torch.autograd.grad(expected, list(leaves.values()), cotangent, allow_unused=True)
    pairs = zip(gradients, direction.values(), strict=True)
    along = sum((gradient * own).sum() for gradient, own in pairs if gradient is not None)
    assert abs(float(along)) > 0
    torch.testing.assert_close((tangent * cotangent).sum(), along, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("contraction", [CONTRACTIONS.build("linf"), Box(half_extent=2.0)], ids=["cube", "box"])
def test_points_keep_their_tangents(contraction):
    origins, directions = torch.randn(2, 5, 3, dtype=torch.float64)
    ones = torch.ones(5, 1, dtype=torch.float64)
    edges = torch.linspace(0.1, 4, 7, dtype=torch.float64).expand(5, -1)

    def points(origins):
        rays = Rays(origins, directions, torch.zeros(5, dtype=torch.int64), 0.1 * ones, 4 * ones)
        return unit_points(rays, Samples(edges, edges), contraction, None)[0]

    tangent = torch.randn_like(origins)
    with forward_ad.dual_level():
        found = forward_ad.unpack_dual(points(forward_ad.make_dual(origins, tangent))).tangent
    assert found is not None
    jacobian = torch.autograd.functional.jacobian(points, origins)
    torch.testing.assert_close(found, (jacobian * tangent).sum((-1, -2)))
