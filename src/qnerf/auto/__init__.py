"""Decides every option that is set to `auto` from the training images and poses, before the training starts."""

from qnerf.auto.resolve import asked, resolve

__all__ = ["asked", "resolve"]
