"""A trained model as quantum hardware would evaluate it: finitely many shots, and noisy gates.

>>> import torch
>>> from qnerf import QuantumLayer
>>> layer = QuantumLayer(3, 1)
>>> x = torch.zeros(4, 3)
>>> with conditions(layer, shots=1000, seed=0):  # every QuantumLayer inside a model measures 1,000 times
...     measured = layer(x)
>>> bool(((measured - layer(x)).abs() < 0.2).all())  # after the block the layer is exact again
True

This is for evaluation: a backward pass through the outputs is a ValueError.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from torch import nn

from qnerf.quantum.layer import QuantumLayer
from qnerf.quantum.measurement import Conditions
from qnerf.quantum.noise import Noise


@contextmanager
def conditions(
    model: nn.Module, *, noise: Noise | Mapping[str, Any] | float | None = None, **options: Any
) -> Iterator[Conditions]:
    """Inside, every QuantumLayer of `model` measures under these `Conditions`.

    Args:
        model: any module.
        noise: errors of the gates and of the readout: a `Noise`, its fields, or a depolarizing probability.
        options: `shots`, `seed`, `method`, `patterns` and `gradients` of `Conditions`.

    Raises:
        ValueError: no positive number of shots, no probability, or an unknown field.
    """
    new = Conditions(noise=Noise.of(noise), **options)
    layers = [module for module in model.modules() if isinstance(module, QuantumLayer)]
    before = [layer.conditions for layer in layers]
    for layer in layers:
        layer.conditions = new
    try:
        yield new
    finally:
        for layer, previous in zip(layers, before, strict=True):
            layer.conditions = previous
