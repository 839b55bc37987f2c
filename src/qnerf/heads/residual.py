"""Stages of circuits, each of which learns what the sum before it leaves (arXiv:2603.10083)."""

from collections.abc import Mapping
from typing import Annotated, Any

import torch
from annotated_types import Interval
from torch import Tensor, nn

from qnerf.heads.base import HEADS
from qnerf.heads.qiren import QirenHead


@HEADS.register("residual")
class ResidualHead(QirenHead):
    """The sum of several QIREN heads that are trained one after another, each for an equal share of the steps.

    Each stage but the first sees the features and the values of the stage before it, as in the public code of
    arXiv:2603.10083. A stage that has had its share stays as it is. The stages themselves are QIREN heads here.

    Args (besides the options of `QirenHead`, which every stage has):
        stages: heads that are summed.
    """

    progress: float = 1.0
    """Share of the training that is done, 0 to 1."""

    @classmethod
    def label(cls, options: Mapping[str, Any]) -> str:
        """`residual2-1L2S`: stages, and the label of each."""
        return f"residual{options['stages']}-{super().label(options)}"

    def __init__(
        self, in_dim: int, out_dim: int, *, stages: Annotated[int, Interval(ge=2, le=64)] = 2, **options: Any
    ) -> None:
        super().__init__(in_dim, out_dim, **options)
        self.later = nn.ModuleList(QirenHead(in_dim + out_dim, out_dim, **options) for _ in range(stages - 1))

    def forward(self, features: Tensor) -> Tensor:
        """(N, in_dim) -> (N, out_dim)."""
        learning = min(int(self.progress * (1 + len(self.later))), len(self.later))
        self.hybrid.train(self.training and learning == 0)
        with torch.set_grad_enabled(torch.is_grad_enabled() and learning == 0):
            total = values = super().forward(features)
        for number, stage in enumerate(self.later[:learning], 1):
            stage.train(self.training and number == learning)
            with torch.set_grad_enabled(torch.is_grad_enabled() and number == learning):
                values = stage(torch.cat([features, values], dim=-1))
            total = total + values
        return total
