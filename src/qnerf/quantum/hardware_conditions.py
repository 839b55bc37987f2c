"""What a trained model would give on hardware: finitely many shots, and noisy gates.

>>> with hardware.conditions(model, shots=1000, seed=0):
...     pictures = render(model)                      # every QuantumLayer in the model measures 1,000 times

Evaluation only: outputs carry no gradients.
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
