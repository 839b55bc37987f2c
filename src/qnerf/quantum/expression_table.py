"""Many expressions at once, in PyTorch: their values for a batch of inputs, differentiable to any order."""

from collections.abc import Sequence
from math import prod

import torch
from torch import Tensor

from qnerf.quantum.expressions import Expression


def offsets(parameters: dict[str, tuple[int, ...]]) -> dict[str, int]:
    """Where each parameter begins in the flat weights."""
    where, first = {}, 0
    for name, shape in parameters.items():
        where[name] = first
        first += prod(shape)
    return where


class ExpressionTable:
    """The values (B, E) of E expressions. Sums are float64, whatever the weights and inputs are.

    Expressions without features give (1, E) if `fixed`, else every value is of one sample.
    """

    def __init__(self, expressions: Sequence[Expression], parameters: dict[str, tuple[int, ...]], fixed: bool) -> None:
        first = offsets(parameters)
        terms = [(row, *term) for row, expression in enumerate(expressions) for term in expression.terms]
        self.size, self.fixed = len(expressions), fixed
        rows = [row for row, *_ in terms]
        self.in_order = rows == list(range(self.size))  # one term each
        # Factor k of every term; -1 stands for the number 1.
        of_weights = _padded([[first[name] + index for name, index in weights] for _, _, weights, _ in terms])
        of_features = _padded([list(features) for *_, features in terms])
        with torch.inference_mode(False):  # they are kept, for training too
            self.tensors = [
                torch.tensor(rows, dtype=torch.int64, device="cpu"),
                torch.tensor([number for _, number, _, _ in terms], dtype=torch.float64, device="cpu"),
                torch.tensor(of_weights, dtype=torch.int64, device="cpu"),
                torch.tensor(of_features, dtype=torch.int64, device="cpu"),
            ]

    def __call__(self, x: Tensor, weights: Tensor) -> Tensor:
        """Values for inputs x (B, features) and flat weights."""
        rows, coefficients, of_weights, of_features = (tensor.to(weights.device) for tensor in self.tensors)
        values = coefficients
        padded = torch.cat([weights.double(), weights.new_ones(1, dtype=torch.float64)])
        for index in of_weights:
            values = values * padded[index]
        values = values[None]
        if not self.fixed:
            inputs = torch.cat([x.double(), x.new_ones(x.shape[0], 1, dtype=torch.float64)], 1)
            if not len(of_features):
                values = values.expand(x.shape[0], -1)
            for index in of_features:
                values = values * inputs[:, index]
        if self.in_order:
            return values
        return values.new_zeros(values.shape[0], self.size).index_add(1, rows, values)


def _padded(rows: list[list[int]]) -> list[list[int]]:
    """Lists of indices -> for each position the index in every list, -1 past its end."""
    longest = max(map(len, rows), default=0)
    return [[row[k] if k < len(row) else -1 for row in rows] for k in range(longest)]
