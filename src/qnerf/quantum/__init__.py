"""Re-uploading circuits as data, and the exact engines that run them."""

from qnerf.quantum.layer import QuantumLayer

__all__ = ["QuantumLayer"]
