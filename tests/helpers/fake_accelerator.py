"""A device that only exists in PyTorch's bookkeeping: `python -m tests.helpers.fake_accelerator field=qboth`.

Every tensor on it has a shape, a dtype and a device and no values, and an operation that mixes it with the CPU is an
error, as on a GPU. Whatever is not the CPU takes the same paths in this package as CUDA. PyTorch without CUDA cannot
move fake tensors to "cuda" nor differentiate there; a device of one's own it can. It is registered for a whole process,
so this is a program of its own. It ends with "done".
"""

import sys
from contextlib import nullcontext, suppress

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import DataDependentOutputException, FakeTensorMode
from torch.overrides import TorchFunctionMode
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

from qnerf.geometry.visibility import SpaceMask
from qnerf.quantum import QuantumLayer, statevector
from qnerf.rendering import proposal_sampler
from tests.helpers.configs import TINY, composed
from tests.helpers.trainer import trainer as built_trainer

DEVICE = "elsewhere"
CASES = (("qiren", 1, None), ("qiren", 2, 0.1), ("cnot", 2, None), ("rx", 2, None))  # ansatz, re-uploadings, noise


class OnDevice(TorchFunctionMode):
    """`torch.tensor(values, device=...)` goes by way of the CPU, because the device has no memory."""

    def __torch_function__(self, function, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        if function is torch.tensor and torch.device(kwargs.get("device") or "cpu").type == DEVICE:
            return torch.tensor(*args, **kwargs | {"device": "cpu"}).to(kwargs["device"])
        if function is Tensor.new_tensor and args[0].device.type == DEVICE:
            return torch.tensor(*args[1:], **{"dtype": args[0].dtype} | kwargs).to(args[0].device)
        return function(*args, **kwargs)


class Settled(TorchDispatchMode):
    """Refuses copies to the device: each one waits for it. After a first step, all that is constant is there."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        out = function(*args, **kwargs or {})
        given = [one for one in pytree.tree_leaves(args) if isinstance(one, Tensor) and one.dim()]
        if isinstance(out, Tensor) and out.device.type == DEVICE and any(one.device.type == "cpu" for one in given):
            raise AssertionError(f"{function} copies {[tuple(one.shape) for one in given]} to the device")
        return out


def moved(module):
    """The module with its parameters and buffers on the device."""
    for part in module.modules():
        for name, parameter in part._parameters.items():
            if parameter is not None:
                part._parameters[name] = nn.Parameter(parameter.detach().to(DEVICE), parameter.requires_grad)
        for name, buffer in part._buffers.items():
            if buffer is not None:
                part._buffers[name] = buffer.detach().to(DEVICE)
    return module


def check(name, outputs, inputs):
    """Differentiates the sum of the outputs: everything is on the device."""
    outputs, inputs = list(outputs), list(inputs)
    gradients = torch.autograd.grad(torch.stack([out.sum() for out in outputs]).sum(), inputs, allow_unused=True)
    found = {tensor.device.type for tensor in (*outputs, *gradients) if tensor is not None}
    assert found == {DEVICE}, f"{name}: {found}"
    print(name)


def main():
    _setup_privateuseone_for_python_backend(DEVICE)
    getattr(torch, DEVICE).get_amp_supported_dtype = lambda: [torch.float16]  # which torch.autocast asks for
    torch.set_num_threads(1)
    with FakeTensorMode(allow_non_fake_inputs=True), OnDevice():
        with suppress(RuntimeError):
            torch.empty(2, device=DEVICE) * torch.ones(2)
            raise AssertionError("a mixture passed unseen")
        for name, spectral, noise in CASES:
            layer = moved(QuantumLayer(4, spectral, ansatz=name, noise=noise, patterns=1, seed=0))
            x = torch.empty(5, 4, device=DEVICE, requires_grad=True)
            check(f"{name} {spectral} {noise}", [layer(x)], [x, *layer.parameters()])
        for method in ("lightcone", "statevector"):
            layer = moved(QuantumLayer(4, 1, method=method))
            check(method, [layer(torch.empty(5, 4, device=DEVICE))], layer.parameters())
    for options in sys.argv[1:]:
        step(options)
    print("done")


def step(options):
    """A training step as the trainer takes it: its rays, its terms, and backward.

    A number that is read, or a shape that depends on values, is an error of fake tensors.
    """
    config = composed(
        "scene=poster", "scene.views=6", *TINY, *options.split(), "qiren.qubits=3", "hash=C7", "train.rays=8",
        "device=cpu", "visibility.cameras=1", "visibility.resolution=16",
    )  # fmt: skip
    trainer = built_trainer(config)
    model, table = trainer.model, trainer.table
    with FakeTensorMode(allow_non_fake_inputs=True), OnDevice():
        moved(model)
        table.device = torch.device(DEVICE)
        for owner in (table, table.training, *filter(None, [trainer.error_map])):
            for name, value in vars(owner).items():
                if torch.is_tensor(value):
                    setattr(owner, name, value.detach().to(DEVICE))
        assert isinstance(model.field.mask, SpaceMask)
        # The device has no generator, so it draws without one.
        statevector.takes_dense_blocks = lambda device, wires: wires <= statevector.DENSE_WIRES
        proposal_sampler.draw_jitter = lambda rays, draws, _: list(torch.empty(draws, len(rays), 1, device=DEVICE))
        with suppress(DataDependentOutputException):
            bool(model.field.mask.grid.any())
            raise AssertionError("a number was read unseen")
        for number, mode in ((0, nullcontext()), (10, Settled())):  # the proposal networks learn in the first of them
            trainer._set_step(number)
            drawn = trainer.draw()
            with mode:
                terms = trainer.terms(drawn)
                parameters = [p for p in model.parameters() if p.requires_grad]
                check(f"{options} {number}", terms.values(), parameters)


if __name__ == "__main__":
    main()
