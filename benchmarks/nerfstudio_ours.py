"""Our model, served (see `benchmarks.peers.serve`): `python -m benchmarks.nerfstudio_ours "OVERRIDES" THREADS [plain]`.

plain: with the PyTorch references in place of the compiled loops.
"""

import sys
from contextlib import nullcontext

import numpy as np
import torch

from benchmarks.peers.serve import serve
from benchmarks.training import build
from qnerf import kernels


class Ours:
    """Trains the configuration on the CPU."""

    def __init__(self, overrides: str) -> None:
        self.trainer, self.evaluator = build(overrides)

    def advance(self, step: int) -> None:
        self.trainer._set_step(step)

    def take_step(self) -> None:
        self.trainer.take_step(measure=False)

    def render(self, path: str) -> None:
        rendered = [self.evaluator.render(view, self.trainer.step) for view in self.evaluator.scene.eval]
        arrays = {
            name: torch.stack([getattr(view, name) for view in rendered]).numpy()
            for name in ("color", "depth", "accumulation")
        }
        np.savez(path, **arrays)


def main() -> None:
    torch.set_num_threads(int(sys.argv[2]))
    with kernels.plain() if sys.argv[3:] == ["plain"] else nullcontext():
        serve(lambda: Ours(sys.argv[1]))


if __name__ == "__main__":
    main()
