"""A picture of the model in training, every so many seconds, for whoever watches a run."""

import time
from collections.abc import Callable

import numpy as np

SHARE = 0.05  # of the time, at most, goes into previews


class Preview:
    """Draws and writes the picture. Nothing that is trained depends on it.

    Args:
        seconds: between two pictures, at least; 0: there are none.
        draw: the picture of the model after a step, such as `Evaluator.preview`.
        write: takes the picture.
    """

    def __init__(self, seconds: float, draw: Callable[[int], np.ndarray], write: Callable[[np.ndarray], None]) -> None:
        self.seconds = seconds
        self.draw = draw
        self.write = write
        self.due = time.monotonic() + seconds

    def refresh(self, step: int, *, now: bool = False) -> None:
        """Writes the picture if it is due, or `now`."""
        start = time.monotonic()
        if not self.seconds or (start < self.due and not now):
            return
        self.write(self.draw(step))
        end = time.monotonic()
        self.due = end + max(self.seconds, (end - start) / SHARE)
