"""When a training has learnt what it can: judged by training rays that it never trains on, not by held-out views."""

import math
from dataclasses import dataclass
from typing import Any


@dataclass
class Plateau:
    """Asked for the PSNR of the validation rays every `every` steps; says when the training is to stop.

    It stops after `patience` checks in a row without a gain of `min_gain_db` over the best so far.
    """

    every: int  # steps between checks; 0: never, and every training ray trains
    patience: int  # checks
    min_gain_db: float
    best: float = -math.inf
    since: int = 0  # checks since the best

    def due(self, step: int) -> bool:
        """Whether a check follows this many steps."""
        return self.every > 0 and step % self.every == 0

    def add(self, psnr: float) -> None:
        """Takes a check's PSNR in dB."""
        if psnr >= self.best + self.min_gain_db:
            self.best, self.since = psnr, 0
        else:
            self.since += 1

    @property
    def reached(self) -> bool:
        return self.every > 0 and self.since >= self.patience

    def state(self) -> dict[str, Any]:
        return {"best": self.best, "since": self.since}

    def load(self, state: dict[str, Any]) -> None:
        self.best, self.since = state["best"], state["since"]
