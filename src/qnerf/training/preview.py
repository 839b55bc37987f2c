"""A picture of one held-out view, every so many seconds, for whoever watches a run."""

import math
import time
from collections.abc import Callable

import numpy as np

from qnerf.training.evaluation import Evaluator

MAX_RAYS = 2**14  # of a preview: a larger view is rendered in every second, third, ... row and column
SHARE = 0.05  # of the time, at most, goes into previews


class Preview:
    """Draws the middle one of the held-out views. Nothing that is trained depends on it.

    Args:
        seconds: between two pictures, at least; 0: there are none.
        write: takes the picture, `Evaluator.picture`.
    """

    def __init__(self, evaluator: Evaluator, seconds: float, write: Callable[[np.ndarray], None]) -> None:
        self.evaluator = evaluator
        self.seconds = seconds
        self.write = write
        self.view = evaluator.scene.eval[len(evaluator.scene.eval) // 2]
        self.due = time.monotonic() + seconds

    def refresh(self, step: int, *, now: bool = False) -> None:
        """Writes the picture if it is due, or `now`."""
        start = time.monotonic()
        if not self.seconds or (start < self.due and not now):
            return
        height, width = self.evaluator.truth(self.view).shape[:2]
        stride = math.ceil(math.sqrt(max(height * width / MAX_RAYS, 1)))
        self.write(self.evaluator.picture(self.evaluator.render(self.view, step, stride)))
        end = time.monotonic()
        self.due = end + max(self.seconds, (end - start) / SHARE)
