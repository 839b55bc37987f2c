"""QIREN beside a linear bypass, with more wires and more values."""

from collections.abc import Collection, Mapping
from dataclasses import replace
from itertools import combinations
from typing import Any

from torch import Tensor, nn

from qnerf.heads.base import HEADS
from qnerf.heads.qiren import QirenHead
from qnerf.quantum.circuit import MAX_STATE_WIRES, Circuit, PauliWord


@HEADS.register("qiren_bypass")
class QirenBypassHead(QirenHead):
    """out = B x + QIREN(x): a linear map of the features beside the circuits.

    Args (besides the options of `QirenHead`):
        bypass: add B x.
        from_zero: the circuits' last linear map starts at 0, so that training begins with B x alone.
        wire_per_feature: as many wires as features, up to 20, instead of `qubits`.
        pairs: the products of all pairs of observables are values, too.

    The control is the bypass alone: an `mlp` of one layer.
    """

    @classmethod
    def label(cls, options: Mapping[str, Any]) -> str:
        """`bypass-1L2S`, and the options that are set besides the default."""
        own = {"bypass": "bypass", "wire_per_feature": "wires", "pairs": "pairs"}
        return "-".join([*(name for key, name in own.items() if options[key]), super().label(options)])

    @classmethod
    def without_effect(cls, options: Mapping[str, Any]) -> Collection[str]:
        return (*super().without_effect(options), *(["qubits"] if options["wire_per_feature"] else []))

    def __init__(
        self,
        in_dim: int,
        out_dim: int,
        *,
        bypass: bool = True,
        from_zero: bool = True,
        wire_per_feature: bool = False,
        pairs: bool = False,
        **options: Any,
    ) -> None:
        self._pairs = pairs
        if wire_per_feature:
            options["qubits"] = min(in_dim, MAX_STATE_WIRES)
        super().__init__(in_dim, out_dim, **options)
        self.bypass = nn.Linear(in_dim, out_dim, bias=False) if bypass else None
        self.rest: Tensor | None
        self.register_buffer("rest", self.values_at_zero() if from_zero else None)
        if from_zero:
            nn.init.zeros_(self.readout.weight)
            nn.init.zeros_(self.readout.bias)

    def described(self, circuit: Circuit) -> Circuit:
        if not self._pairs:
            return circuit
        words = circuit.words
        products: tuple[PauliWord, ...] = tuple(a + b for a, b in combinations(words, 2))
        return replace(circuit, observables=words + products)

    def forward(self, features: Tensor) -> Tensor:
        """(N, in_dim) -> (N, out_dim)."""
        values = self.measured(features)
        if self.rest is not None:  # a bias that cancels it would lag behind the growing weights
            values = values - self.rest
        out: Tensor = self.readout(values * self.gain)
        return out if self.bypass is None else out + self.bypass(features)
