"""What a scene needs: every option that is set to `auto` is decided from the training data alone, at the start."""

from qnerf.auto.resolve import asked, resolve

__all__ = ["asked", "resolve"]
