"""Early stopping, judged by training rays that are held out for validation. Held-out views play no part.

Why a run stopped before its last step is in its summary, as `stopped`.
"""

import math
from dataclasses import dataclass
from typing import Any

PLATEAU, PRUNED = "plateau", "pruned"
"""Values of `stopped`: training no longer gained; or a search gave the run up, which is then interrupted, not finished.
"""


@dataclass
class Plateau:
    """Stops the training after `patience` checks in a row without a gain of `min_gain_db` over the best PSNR so far.

    >>> plateau = Plateau(every=10, patience=2, min_gain_db=0.1)
    >>> for psnr in (20.0, 21.0, 21.05, 21.02):
    ...     plateau.add(psnr)
    >>> plateau.reached
    True
    """

    every: int  # steps between checks; 0: never stop early
    patience: int  # checks
    min_gain_db: float
    after: int = 0  # steps before the first check
    best: float = -math.inf
    since: int = 0  # checks since the best

    def due(self, step: int) -> bool:
        """Whether a check follows this many steps."""
        return self.every > 0 and step > self.after and step % self.every == 0

    def add(self, psnr: float) -> None:
        """Records the validation PSNR of a check, in dB."""
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
