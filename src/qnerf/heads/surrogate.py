"""Random Fourier features on a circuit's spectrum: the classical surrogate of a re-uploading circuit."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from qnerf.config.bounds import Count, Factor
from qnerf.heads.base import HEADS, Head
from qnerf.heads.qiren import Normalisation, Statistics, check_samples, without_drift
from qnerf.quantum.circuit import Spectral, Wires


@HEADS.register("surrogate")
class SurrogateHead(Head):
    """Angles as in a hybrid layer, then cos(k . angles) and sin(k . angles) for frequencies k that a circuit has.

    A circuit of n wires with S encodings of scale 1 gives trigonometric polynomials with k in {-S, ..., S}^n
    (arXiv:2008.08605). A re-uploading circuit fixes their coefficients by its few angles; here `features` of them,
    drawn at random, are free (arXiv:2210.13200).

    Args:
        in_dim, out_dim: features in and values out.
        qubits: n, the number of angles.
        spectral: S.
        features: frequencies that are drawn, each with a cosine and a sine.
        input_scale: factor on the normalised angles, radians.
        statistics: `batch` or `first`, see `Normalisation`.

    A frequency is drawn as often as it arises in the circuit: each encoding adds a difference of two bits to each
    component of k.
    """

    recipe = "qiren"
    frequencies: Tensor

    @classmethod
    def label(cls, options: Mapping[str, Any]) -> str:
        """`surrogate8S2x16`: angles, encodings, features."""
        return f"surrogate{options['qubits']}S{options['spectral']}x{options['features']}"

    def __init__(
        self,
        in_dim: int,
        out_dim: int,
        *,
        qubits: Wires = 8,
        spectral: Spectral = 2,
        features: Count = 64,
        input_scale: Factor = 0.3,
        statistics: Statistics = "batch",
    ) -> None:
        super().__init__()
        self.linear = nn.Linear(in_dim, qubits)
        self.norm = Normalisation(qubits, statistics=statistics)
        self.input_scale = input_scale
        first, second = torch.randint(2, (2, spectral, features, qubits)).sum(1)
        self.register_buffer("frequencies", (first - second).to(torch.get_default_dtype()))
        self.readout = nn.Linear(2 * features, out_dim)
        if not self.readout.weight.is_meta:
            with torch.no_grad():  # angles of 0 give 0
                self.readout.bias.copy_(-self.readout.weight[:, :features].sum(1))

    def forward(self, features: Tensor) -> Tensor:
        """(N, in_dim) -> (N, out_dim)."""
        if self.training and not self.norm.known:
            check_samples(len(features))
        angles = self.norm(without_drift(self.linear, features, self.training and self.norm.statistics == "batch"))
        phases = (angles * self.input_scale) @ self.frequencies.T
        return self.readout(torch.cat([phases.cos(), phases.sin()], -1))
