"""The layer under torch.func, forward-mode derivatives and torch.compile."""

import copy
import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.autograd import forward_ad
from torch.func import functional_call, grad, hessian, jacfwd, jacrev, jvp, vmap

from qnerf.heads import QirenHead
from qnerf.quantum.hardware_conditions import conditions
from qnerf.quantum.layer import QuantumLayer

pytestmark = [
    pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated"),  # PyTorch's own, for derivatives
    pytest.mark.filterwarnings("ignore:Guards may run slower on Python 3.13.0"),
]
Layers = tuple[QuantumLayer, QuantumLayer]


@pytest.fixture(params=["lightcone", "statevector"])
def layers(request: pytest.FixtureRequest) -> Layers:
    """A layer on the compiled engine, and the same in plain PyTorch."""
    spectral = {"lightcone": 1, "statevector": 2}[request.param]
    fast = QuantumLayer(4, spectral, method=request.param, backend="compiled").double()
    plain = QuantumLayer(4, spectral, method=request.param, backend="torch").double()
    plain.load_state_dict(fast.state_dict())
    return fast, plain


def of_weights(layer: QuantumLayer) -> Callable[[dict[str, Tensor], Tensor], Tensor]:
    return lambda weights, x: functional_call(layer, weights, (x,)).square().sum()


TRANSFORMS: list[Callable[[QuantumLayer, Tensor], Any]] = [
    lambda layer, x: vmap(grad(of_weights(layer)), (None, 0))(dict(layer.named_parameters()), x),
    lambda layer, x: vmap(layer)(x),
    lambda layer, x: jacrev(layer)(x),
    lambda layer, x: jacfwd(layer)(x),
    lambda layer, x: vmap(hessian(lambda one: layer(one).sum()))(x),
    lambda layer, x: jvp(layer, (x,), (x.cos(),)),
]


def test_torch_func_gives_what_plain_pytorch_gives(layers: Layers) -> None:
    x = torch.randn(3, 4, dtype=torch.float64)
    for transform in TRANSFORMS:
        fast, plain = (transform(layer, x) for layer in layers)
        torch.testing.assert_close(fast, plain, rtol=0, atol=1e-12)
    assert layers[0].cost(3).backend == "compiled"  # as before


def test_forward_mode_gives_what_backward_mode_gives(layers: Layers) -> None:
    x, direction = torch.randn(2, 3, 4, dtype=torch.float64)
    with forward_ad.dual_level():
        tangent = forward_ad.unpack_dual(layers[0](forward_ad.make_dual(x, direction))).tangent
    assert tangent is not None
    x.requires_grad_()
    cotangent = torch.randn_like(tangent)
    (gradient,) = torch.autograd.grad(layers[0](x), x, cotangent)
    torch.testing.assert_close((tangent * cotangent).sum(), (gradient * direction).sum())


@pytest.fixture
def compiled() -> Callable[[nn.Module], Callable[[Tensor], Tensor]]:
    """torch.compile without the C++ compiler: dynamo and autograd still trace the whole model."""
    torch.compiler.reset()
    return lambda model: torch.compile(model, backend="aot_eager", fullgraph=True)


def step(model: Callable[[Tensor], Tensor], parameters: list[nn.Parameter], x: Tensor) -> list[Tensor]:
    """Outputs and all gradients."""
    x = x.clone().requires_grad_()
    out = model(x)
    return [out.detach(), *torch.autograd.grad(out.square().sum(), [x, *parameters])]


def test_compiled_model_computes_the_same_bits(compiled: Any, layers: Layers) -> None:
    model = nn.Sequential(nn.Linear(5, 4), layers[0], nn.Linear(4, 2)).double()
    fast = compiled(model)
    for shape in ((7, 5), (20, 5), (2, 3, 5)):
        x = torch.randn(*shape, dtype=torch.float64)
        expected = step(model, list(model.parameters()), x)
        assert all(map(torch.equal, step(fast, list(model.parameters()), x), expected))
    with torch.no_grad():
        assert torch.equal(fast(x), model(x))


def test_compiled_head_computes_the_same_bits(compiled: Any) -> None:
    head = QirenHead(5, 3, layers=2, spectral=2, qubits=3)
    others = copy.deepcopy(head)
    x = torch.randn(16, 5)
    fast = step(compiled(head), list(head.parameters()), x)
    assert all(map(torch.equal, fast, step(others, list(others.parameters()), x)))


def test_copies_compile_on_their_own(compiled: Any) -> None:
    copies: list[Callable[[QuantumLayer], QuantumLayer]] = [
        copy.deepcopy,
        lambda layer: pickle.loads(pickle.dumps(layer)),
    ]
    for copied in copies:
        other = copied(QuantumLayer(3, 2))
        x = torch.randn(5, 3)
        assert torch.equal(compiled(other)(x), other(x))


def test_compiled_layer_measures_under_hardware_conditions(compiled: Any) -> None:
    layer = QuantumLayer(3, 1)
    fast = compiled(layer)
    x = torch.randn(5, 3)
    exact = fast(x).detach()
    with conditions(layer, shots=100, seed=1):
        measured = fast(x)
        torch.testing.assert_close(measured * 50, (measured * 50).round())  # counts of 100 shots
        with pytest.raises(ValueError, match="carry no gradients"):
            measured.sum().backward()
    assert not torch.equal(measured, exact)
    assert torch.equal(fast(x).detach(), exact)
