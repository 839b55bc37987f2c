"""Compiled CPU loops. Each has a plain PyTorch reference, and tests that both agree.

`dispatch.py` has the table of the loops: which module, dtype and device each of them serves.
"""

from qnerf.kernels.dispatch import is_transformed, plain

__all__ = ["is_transformed", "plain"]
