"""A trained model as quantum hardware would evaluate it: finitely many shots, and noisy gates.

>>> import torch
>>> from qnerf import QuantumLayer
>>> layer = QuantumLayer(3, 1)
>>> x = torch.zeros(4, 3)
>>> with conditions(layer, shots=1000, seed=0):  # every QuantumLayer inside a model measures 1,000 times
...     measured = layer(x)
>>> bool(((measured - layer(x)).abs() < 0.2).all())  # after the block the layer is exact again
True

This is for evaluation: the outputs carry no gradients.
"""

from collections.abc import Iterator
from contextlib import contextmanager

from torch import nn

from qnerf.quantum.layer import QuantumLayer
from qnerf.quantum.measurement import Conditions
from qnerf.quantum.pennylane import Noise


@contextmanager
def conditions(
    model: nn.Module, *, shots: int | None = None, noise: Noise | float | None = None, joint: bool = True, seed: int = 0
) -> Iterator[Conditions]:
    """Every QuantumLayer of `model` measures under these conditions. A float is a depolarizing probability."""
    given = Conditions(shots, Noise(depolarizing=noise) if isinstance(noise, (int, float)) else noise, joint, seed)
    layers = [module for module in model.modules() if isinstance(module, QuantumLayer)]
    before = [layer.conditions for layer in layers]
    for layer in layers:
        layer.conditions = given
    try:
        yield given
    finally:
        for layer, previous in zip(layers, before, strict=True):
            layer.conditions = previous
