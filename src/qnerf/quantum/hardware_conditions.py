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
    """Inside, every QuantumLayer of `model` measures under these `Conditions`.

    Args:
        model: any module.
        shots: measurements of each circuit; None for exact expectation values.
        noise: channels after every gate; a number is a depolarizing probability.
        joint: whether a shot reads all wires at once, as a device does.
        seed: of the shots.

    Raises:
        ValueError: no positive number of shots, or no probability.
    """
    new = Conditions(shots, Noise(depolarizing=noise) if isinstance(noise, (int, float)) else noise, joint, seed)
    layers = [module for module in model.modules() if isinstance(module, QuantumLayer)]
    before = [layer.conditions for layer in layers]
    for layer in layers:
        layer.conditions = new
    try:
        yield new
    finally:
        for layer, previous in zip(layers, before, strict=True):
            layer.conditions = previous
