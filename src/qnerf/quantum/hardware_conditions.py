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

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from torch import nn

from qnerf.quantum.layer import QuantumLayer
from qnerf.quantum.measurement import Conditions
from qnerf.quantum.noise import Noise

CURE = "of a layer that from_qnode made, QuantumLayer(layer.circuit(features)) is one"


def require_layers(model: nn.Module) -> list[QuantumLayer]:
    """Every QuantumLayer of the model; a warning where it has circuits of PennyLane beside them.

    Raises:
        ValueError: there is none.
    """
    layers = _layers(model)
    if not layers:
        raise ValueError(f"expected a QuantumLayer or a module that has one, got {type(model).__name__}; {CURE}")
    of_pennylane = [name for name, module in model.named_modules() if hasattr(module, "qnode_weights")]
    if of_pennylane:
        warnings.warn(f"{', '.join(of_pennylane)}: circuits of PennyLane stay as they are; {CURE}", stacklevel=4)
    return layers


def _layers(model: nn.Module) -> list[QuantumLayer]:
    return [module for module in model.modules() if isinstance(module, QuantumLayer)]


@contextmanager
def conditions(
    model: nn.Module, *, noise: Noise | Mapping[str, Any] | float | None = None, **options: Any
) -> Iterator[Conditions]:
    """Inside, every QuantumLayer of `model` measures under these `Conditions`.

    Args:
        model: any module.
        noise: errors of the gates and of the readout: a `Noise`, its fields, or a depolarizing probability.
        options: `shots`, `seed`, `method`, `patterns` and `gradients` of `Conditions`.

    Circuits of PennyLane in the model stay exact, with a warning.

    Raises:
        ValueError: no positive number of shots, no probability, or an unknown field; shots or noise for a model
            without a QuantumLayer.
    """
    new = Conditions(noise=Noise.of(noise), **options)
    layers = require_layers(model) if new.shots or new.noise else _layers(model)
    before = [layer.conditions for layer in layers]
    for layer in layers:
        layer.conditions = new
    try:
        yield new
    finally:
        for layer, previous in zip(layers, before, strict=True):
            layer.conditions = previous
