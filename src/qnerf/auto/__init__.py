"""Decides every option that is set to `auto` from the training images and poses, before the training starts."""

from qnerf.auto.resolve import AUTO, asked, resolve

__all__ = ["AUTO", "asked", "resolve"]
