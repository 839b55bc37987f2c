"""Quantum-classical neural radiance fields."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from qnerf.cli.python import load, run, runs, sweep
    from qnerf.quantum import QuantumLayer, from_qnode
    from qnerf.records.track import track

__version__ = "0.1.0"
__all__ = ["QuantumLayer", "from_qnode", "load", "run", "runs", "sweep", "track"]
_MODULES = {
    "QuantumLayer": "qnerf.quantum",
    "from_qnode": "qnerf.quantum",
    "track": "qnerf.records.track",
    **dict.fromkeys(("load", "run", "runs", "sweep"), "qnerf.cli.python"),
}


def __getattr__(name: str) -> Any:
    # Late, so that the command line starts without PyTorch and sets its threads up first.
    if name in _MODULES:
        return getattr(import_module(_MODULES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
