"""Quantum-classical neural radiance fields."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from qnerf.quantum import QuantumLayer, from_qnode

__version__ = "0.1.0"
__all__ = ["QuantumLayer", "from_qnode"]


def __getattr__(name: str) -> Any:
    # Late, so that the command line starts without PyTorch and sets its threads up first.
    if name in __all__:
        from qnerf import quantum

        return getattr(quantum, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
