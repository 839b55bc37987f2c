"""Quantum-classical neural radiance fields."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from qnerf.quantum import QuantumLayer

__version__ = "0.1.0"
__all__ = ["QuantumLayer"]


def __getattr__(name: str) -> Any:
    # Late, so that the command line starts without PyTorch and sets its threads up first.
    if name == "QuantumLayer":
        from qnerf.quantum import QuantumLayer

        return QuantumLayer
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
