"""The layer under torch.func, forward-mode derivatives and torch.compile, for every engine."""

import pickle

import pytest
import torch
from torch import nn
from torch.autograd import forward_ad
from torch.func import functional_call, grad, hessian, jacfwd, jacrev, jvp, vmap

from qnerf.quantum.hardware_conditions import conditions
from qnerf.quantum.layer import QuantumLayer
from tests.quantum.test_any_circuit import MIXED

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated")  # PyTorch's own, for derivatives


@pytest.fixture(params=["lightcone", "statevector", "any"])
def layers(request):
    """A layer of 4 features on a compiled engine, and the same in plain PyTorch."""
    torch.manual_seed(0)
    kind = {"lightcone": (4, 1, "lightcone"), "statevector": (4, 2), "any": (MIXED,)}[request.param]
    method = {"method": "lightcone"} if request.param == "lightcone" else {}
    fast, plain = (QuantumLayer(*kind[:2], **method, backend=own).double() for own in ("compiled", "torch"))
    plain.load_state_dict(fast.state_dict())
    return fast, plain


def of_weights(layer):
    return lambda weights, x: functional_call(layer, weights, (x,)).square().sum()


TRANSFORMS = [
    lambda layer, x: vmap(grad(of_weights(layer)), (None, 0))(dict(layer.named_parameters()), x),
    lambda layer, x: vmap(layer)(x),
    lambda layer, x: jacrev(layer)(x),
    lambda layer, x: jacfwd(layer)(x),
    lambda layer, x: vmap(hessian(lambda one: layer(one).sum()))(x),
    lambda layer, x: jvp(layer, (x,), (x.cos(),)),
]


def test_torch_func_gives_what_plain_pytorch_gives(layers):
    x = torch.randn(3, 4, dtype=torch.float64)
    for transform in TRANSFORMS:
        fast, plain = (transform(layer, x) for layer in layers)
        torch.testing.assert_close(fast, plain, rtol=0, atol=1e-12)
    assert layers[0].cost(3).backend == "compiled"  # as before


def test_forward_mode_gives_what_backward_mode_gives(layers):
    x, direction = torch.randn(2, 3, 4, dtype=torch.float64)
    with forward_ad.dual_level():
        tangent = forward_ad.unpack_dual(layers[0](forward_ad.make_dual(x, direction))).tangent
    assert tangent is not None
    x.requires_grad_()
    cotangent = torch.randn_like(tangent)
    (gradient,) = torch.autograd.grad(layers[0](x), x, cotangent)
    torch.testing.assert_close((tangent * cotangent).sum(), (gradient * direction).sum())


def step(model, parameters, x):
    """Outputs and all gradients."""
    x = x.clone().requires_grad_()
    out = model(x)
    return [out.detach(), *torch.autograd.grad(out.square().sum(), [x, *parameters])]


def test_compiled_model_computes_the_same_bits(layers):
    """Without the C++ compiler: dynamo and autograd still trace all but the layer."""
    torch.compiler.reset()
    copied = pickle.loads(pickle.dumps(layers[0]))
    for layer in (layers[0], copied):
        model = nn.Sequential(nn.Linear(5, 4), layer, nn.Linear(layer.outputs, 2)).double()
        fast = torch.compile(model, backend="aot_eager")
        for shape in ((7, 5), (2, 3, 5)):
            x = torch.randn(*shape, dtype=torch.float64)
            expected = step(model, list(model.parameters()), x)
            assert all(map(torch.equal, step(fast, list(model.parameters()), x), expected))
        with torch.no_grad(), conditions(layer, shots=100, seed=1):
            assert not torch.equal(fast(x), expected[0])  # the conditions of this call
