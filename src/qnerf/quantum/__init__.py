"""Exact evaluation of batched data re-uploading circuits; `QuantumLayer` is the way in."""

from qnerf.quantum.layer import QuantumLayer

__all__ = ["QuantumLayer"]
