"""A run in one dtype computes in no other: every PyTorch operation of a step is seen."""

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from qnerf.quantum import QuantumLayer
from tests.helpers.trainer import trainer


class Watcher(TorchDispatchMode):
    """Operations that give floating tensors of more than one number that are not of `dtype`."""

    def __init__(self, dtype):
        super().__init__()
        self.known = {dtype, dtype.to_complex()}
        self.found = set()

    def __torch_dispatch__(self, function, types, given=(), options=None):
        out = function(*given, **(options or {}))
        for tensor in tree_leaves(out):
            floats = isinstance(tensor, torch.Tensor) and (tensor.is_floating_point() or tensor.is_complex())
            if floats and tensor.dtype not in self.known and tensor.numel() > 1:
                self.found.add(f"{function}")
        return out


@pytest.mark.parametrize(
    "options",
    [
        ("numerics.dtype=float32", "field=classical", "cameras=se3", "appearance=2"),
        ("numerics.dtype=float64", "field=qboth", "qiren.qubits=3", "qiren.method=lightcone", "train.rays=64"),
        ("numerics.dtype=float64", "field=qdensity", "encoder=rff", "qiren.qubits=3", "shading=none"),
    ],
)
def test_a_step_makes_no_numbers_of_another_dtype(tiny, options):
    """Circuits, random features and angles take float64 in a float32 step, too, on purpose."""
    taken = trainer(tiny(*options, "train.distortion=0.01"))
    taken.take_step(measure=False)
    with Watcher(next(taken.model.parameters()).dtype) as watcher:
        taken.take_step(measure=True)
    assert not watcher.found


def test_layer_computes_in_the_wider_of_its_own_dtype_and_its_input_s():
    for method in ("statevector", "lightcone"):
        for backend in ("compiled", "torch"):
            layer = QuantumLayer(3, 1, method=method, backend=backend)
            assert layer(torch.zeros(2, 3)).dtype == torch.float32
            assert layer(torch.zeros(2, 3, dtype=torch.float64)).dtype == torch.float64
            assert layer(torch.zeros(2, 3, dtype=torch.bfloat16)).dtype == torch.float32
            assert layer.double()(torch.zeros(2, 3)).dtype == torch.float64
