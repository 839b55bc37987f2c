"""Decides every option that is set to `auto` from the training images and poses, before the training starts."""

from qnerf.auto.resolve import asked, columns, resolve
from qnerf.auto.rules import AUTO, Decision

__all__ = ["AUTO", "Decision", "asked", "columns", "resolve"]
