"""Derivatives of any order and in any mode: those of compiled loops, and those that must not flow."""

import threading
from dataclasses import replace
from functools import partial

import pytest
import torch
from torch.autograd import forward_ad
from torch.autograd.functional import jacobian
from torch.func import functional_call, grad, hessian, jacfwd, jacrev, jvp

from qnerf.geometry.contraction import CONTRACTIONS
from qnerf.heads import HEADS
from qnerf.heads.activations import trunc_exp
from qnerf.kernels import is_transformed
from qnerf.kernels.grid_mlp import Grid, grid_mlp
from qnerf.kernels.hashgrid import hash_encode
from qnerf.kernels.mlp import layers_of
from qnerf.quantum import QuantumLayer, statevector
from qnerf.quantum.hardware_conditions import conditions
from qnerf.rendering.render import volume_weights
from qnerf.rendering.samplers import SAMPLERS
from qnerf.rendering.shading import MergeShading
from qnerf.training.losses import distortion, interlevel
from qnerf.types import Rays, Samples

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated")  # PyTorch's own, for derivatives


def random(*shape):
    return torch.rand(*shape, dtype=torch.float64)


def edges(intervals):
    return torch.linspace(0, 1, intervals + 1, dtype=torch.float64).expand(2, -1)


def cases():
    """Functions with compiled loops, and inputs at which they are smooth."""
    cells, points = torch.tensor([2, 5]), random(3, 3)
    layers = [random(4, 4), random(4), random(2, 4), random(2)]
    final, proposal = Samples(edges(4), edges(4)), Samples(edges(3), edges(3))
    high = 0.3 + random(2, 4)
    merge = MergeShading(parts=2)

    def merged(shares, geometry):
        shaded = merge(shares, geometry)
        assert shaded.shares is not None
        return shaded.shares, shaded.geometry

    def field(table, *parameters):
        return grid_mlp(points, None, Grid(table, cells, True), layers_of(parameters))

    return {
        "volume weights": (lambda density: volume_weights(density, 0.2 + edges(5)[:, 1:]), (random(2, 5),)),
        "distortion": (partial(distortion, final), (random(2, 4),)),
        "interlevel": (lambda w: interlevel(final, high, [(proposal, w)]), (0.1 * random(2, 3),)),
        "merged samples": (merged, (0.1 + random(2, 6), random(2, 6, 2))),
        "hash grid": (partial(hash_encode, resolutions=cells), (points, random(2, 32, 2))),
        "hash grid and MLP": (field, (random(2, 32, 2), *layers)),
        "trunc_exp": (trunc_exp, (torch.tensor([-20.0, -3, 0, 3], dtype=torch.float64),)),
        "amplitudes": (HEADS.build("amplitude", 3, 2, registers=[2]).double(), (random(4, 3),)),
    }


NAMES = [name for name in cases() if name != "trunc_exp"]  # whose derivative is another one beyond its bounds


@pytest.mark.parametrize("name", NAMES)
def test_first_and_second_derivatives_are_those_of_finite_differences(name):
    function, inputs = cases()[name]
    inputs = tuple(tensor.clone().requires_grad_() for tensor in inputs)
    assert torch.autograd.gradcheck(function, inputs)
    assert torch.autograd.gradgradcheck(function, inputs)


@pytest.mark.parametrize("name", cases())
def test_all_modes_give_the_same_second_derivatives(name):
    function, inputs = cases()[name]

    def value(first):
        found = function(first, *inputs[1:])
        found = found if isinstance(found, tuple) else (found,)
        return torch.stack([part.square().sum() for part in found]).sum()

    at = inputs[0].clone().requires_grad_()
    (first,) = torch.autograd.grad(value(at) + (at**3).sum(), at, create_graph=True)
    (along,) = torch.autograd.grad(first.sum(), at)  # a term to which others are added does not drop out
    expected = torch.autograd.functional.hessian(value, inputs[0])
    torch.testing.assert_close(along - 6 * inputs[0], expected.sum(dim=tuple(range(inputs[0].ndim))))
    for second in (hessian(value), jacrev(jacrev(value)), jacfwd(jacfwd(value)), jacrev(jacfwd(value))):
        torch.testing.assert_close(second(inputs[0]).detach(), expected)


def test_batched_gradients_are_the_others():
    """`vectorize=True` runs the backward pass once, under a vmap of autograd's own."""
    for name in cases():
        function, inputs = cases()[name]
        torch.testing.assert_close(jacobian(function, inputs, vectorize=True), jacobian(function, inputs))


@pytest.mark.filterwarnings("ignore:.*should not be instantiated:DeprecationWarning")  # PyTorch's own
def test_trunc_exp_compiles_as_a_whole():
    torch.compiler.reset()
    at = torch.linspace(-20, 20, 9)
    torch.testing.assert_close(torch.compile(trunc_exp, backend="aot_eager", fullgraph=True)(at), at.exp())


def test_a_tiny_part_has_the_same_bounded_derivative_in_every_mode():
    merge, geometry = MergeShading(parts=3), random(1, 4, 2)
    shares = 1e-4 * torch.tensor([[1.0, 2, 3, 2]], dtype=torch.float64)

    def mean(shares):
        return merge(shares, geometry).geometry

    backward = torch.autograd.functional.jacobian(mean, shares)
    torch.testing.assert_close(jacfwd(mean)(shares), backward)
    torch.testing.assert_close(jacrev(mean)(shares), backward)


def rays(origins):
    ones = torch.ones_like(origins[:, :1])
    directions = torch.nn.functional.normalize(torch.ones_like(origins), dim=-1)
    return Rays(origins, directions, torch.zeros(len(origins), dtype=torch.int64), 0.1 * ones, 4 * ones)


@pytest.mark.parametrize("name", SAMPLERS.names())
def test_where_a_ray_is_cut_has_no_derivative(name):
    small = {"proposal": {"samples": [8, 6], "final": 4, "log2_table_size": 4}}
    sampler = SAMPLERS.build(name, CONTRACTIONS.build("linf"), **small.get(name, {})).double()

    def edges(origins):
        moved = rays(origins)
        moved = replace(moved, near=moved.near + origins[:, :1].abs())
        found = sampler(moved, lambda points: points.square().sum(-1), step=11)
        return torch.cat([found.samples.edges, *(weights for _, weights in found.proposals)], -1)

    origins = random(3, 3)
    assert not jvp(edges, (origins,), (torch.ones_like(origins),))[1].any()


@pytest.mark.parametrize(("step", "learns"), [(11, False), (14, True)])
def test_proposal_weights_have_derivatives_only_in_steps_that_train_the_networks(step, learns):
    sampler = SAMPLERS.build(
        "proposal", CONTRACTIONS.build("linf"), samples=[8, 6], final=4, log2_table_size=4
    ).double()
    at = {name: parameter.detach() for name, parameter in sampler.named_parameters()}

    def weights(parameters):
        found = functional_call(sampler, parameters, (rays(torch.ones(3, 3).double()), torch.sum), {"step": step})
        return torch.cat([weights for _, weights in found.proposals], -1)

    tangent = jvp(weights, (at,), ({name: torch.ones_like(value) for name, value in at.items()},))[1]
    assert bool(tangent.any()) is learns


def test_a_transformation_in_one_thread_leaves_the_others_alone():
    seen = []
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(random(3), random(3))
        thread = threading.Thread(target=lambda: seen.append(is_transformed(random(3))))
        thread.start()
        thread.join()
        assert is_transformed(dual)
        assert is_transformed(random(3), dual)
    assert seen == [False]


def test_circuits_with_more_samples_than_autograd_stores_at_once(monkeypatch):
    monkeypatch.setattr(statevector, "CHUNK_BYTES", 1)  # so that a chunk is one sample
    head = HEADS.build("qiren", 4, 3).eval()
    x = torch.rand(5, 4)
    found = grad(lambda x: head(x).square().sum())(x)
    x.requires_grad_()
    head(x).square().sum().backward()
    torch.testing.assert_close(found, x.grad, rtol=1e-4, atol=1e-5)


def test_shots_and_noise_under_a_transformation_are_refused():
    layer, x = QuantumLayer(2, 1), torch.rand(3, 2)
    with conditions(layer, shots=10), pytest.raises(ValueError, match=r"torch\.func"):
        jvp(layer, (x,), (x,))


def test_tables_made_in_inference_mode_serve_for_training():
    for build in (
        lambda: HEADS.build("amplitude", 5, 2, registers=[4]),
        lambda: QuantumLayer(5, 2, backend="torch", method="statevector"),
        lambda: QuantumLayer(5, 1, backend="torch", method="lightcone"),
    ):
        x = torch.rand(4, 5)
        with torch.inference_mode():
            build()(x)
        build()(x).sum().backward()
