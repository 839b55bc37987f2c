"""When PyTorch's own threads pay in a training step: compiled loops always have theirs."""

from torch import nn

from qnerf.quantum import QuantumLayer

MANY_PRODUCTS = 5e8
"""From so many multiplications in a step's linear layers, forward, several threads pay."""


def few_products(model: nn.Module, points: int) -> bool:
    """Whether a step that evaluates the model at `points` points is many small operations, and no large one.

    Modules from outside this package and PennyLane's circuits are large operations of PyTorch.
    """
    modules = list(model.modules())
    circuits = [module for module in modules if isinstance(module, QuantumLayer)]
    if any(circuit.method == "pennylane" or circuit.backend == "torch" for circuit in circuits):
        return False
    if any(type(module).__module__.split(".")[0] not in ("qnerf", "torch") for module in modules):
        return False
    return points * sum(module.weight.numel() for module in modules if isinstance(module, nn.Linear)) < MANY_PRODUCTS
