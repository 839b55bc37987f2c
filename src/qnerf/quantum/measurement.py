"""Circuits measured as on hardware: with finitely many shots or noisy gates. The outputs carry no gradients."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from qnerf.quantum import density, statevector
from qnerf.quantum.circuit import Circuit
from qnerf.quantum.normal_form import normal_form, z_eigenvalues
from qnerf.quantum.pennylane import Noise, check_shots

CHUNK = 4096  # samples whose probabilities are computed at once


@dataclass
class Conditions:
    """How a circuit is measured.

    Args:
        shots: measurements of each circuit; None for exact expectation values.
        noise: channels after every gate; None for none.
        joint: True reads all wires in every shot, as a device does. False draws each output from its own binomial,
            which is faster. Every single output has the same distribution either way; only the correlations between
            the outputs of one sample differ. Noisy shots are always drawn independently.
        seed: of the shots.

    Raises:
        ValueError: `shots` is not a positive integer, or `noise` is not a `Noise`.
    """

    shots: int | None = None
    noise: Noise | None = None
    joint: bool = True
    seed: int = 0
    random: np.random.Generator = field(init=False, repr=False)
    noisy_coefficients: dict[bytes, Tensor] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        check_shots(self.shots)
        if self.noise is not None and not isinstance(self.noise, Noise):
            raise ValueError(f"noise expects a Noise, a depolarizing probability or None, got {self.noise!r}")
        self.random = np.random.default_rng(self.seed)

    @property
    def noisy(self) -> bool:
        return self.noise is not None and self.noise.any

    @property
    def needs_exact(self) -> bool:
        """Whether `measure` starts from the exact expectation values."""
        return not self.noisy and (self.shots is None or not self.joint)


class _WithoutGradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, *sources: Tensor) -> Tensor:
        return values.view_as(values)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        raise ValueError("outputs under hardware conditions carry no gradients; train outside the conditions")


def measure(circuit: Circuit, x: Tensor, weights: Tensor, exact: Tensor | None, conditions: Conditions) -> Tensor:
    """Outputs (B, outputs) for x (B, n) and stacked weights (rows, 3, n). A backward pass through them is a ValueError.

    `exact` are the exact expectation values, which `conditions.needs_exact` asks for.
    """
    with torch.no_grad():
        values = _measured(circuit, x, weights, exact, conditions)
    out: Tensor = _WithoutGradient.apply(values, x, weights)
    return out


def _measured(circuit: Circuit, x: Tensor, weights: Tensor, exact: Tensor | None, conditions: Conditions) -> Tensor:
    if conditions.noise is not None and conditions.noisy:
        exact = density.evaluate(circuit, x, weights, conditions.noise, conditions.noisy_coefficients)
    if conditions.shots is None:
        assert exact is not None
        return exact
    if conditions.joint and not conditions.noisy:
        return torch.cat([_measure_all_wires(circuit, part, weights, conditions) for part in x.split(CHUNK)])
    assert exact is not None
    return binomial(exact, conditions.shots, conditions.random)


def binomial(exact: Tensor, shots: int, random: np.random.Generator) -> Tensor:
    """Means of `shots` independent +1 or -1 with expectation `exact`; NaN stays NaN."""
    values = exact.detach().double().cpu().numpy()
    up = random.binomial(shots, np.clip(np.nan_to_num((1 + values) / 2), 0, 1))
    means = np.where(np.isnan(values), np.nan, 2 * up / shots - 1)
    return torch.from_numpy(means).to(exact)


def _measure_all_wires(circuit: Circuit, x: Tensor, weights: Tensor, conditions: Conditions) -> Tensor:
    form = normal_form(circuit)
    assert conditions.shots is not None
    probabilities = statevector.probabilities(form, x.double(), weights.double()).cpu().numpy()
    if not len(probabilities):
        return x.new_zeros(0, len(circuit.observables))
    counts = multinomial(conditions.shots, np.nan_to_num(probabilities), conditions.random)
    means = counts @ z_eigenvalues(form.measured, form.wires).T / conditions.shots
    means[np.isnan(probabilities).any(1)] = np.nan
    return torch.from_numpy(means).to(x)


def multinomial(shots: int, probabilities: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Counts (B, 2^n) of `shots` bit strings for each row of probabilities.

    Wire after wire, a binomial splits the shots that agree so far. NumPy's `Generator.multinomial` would draw other
    counts from the same seed, and stored results name their seeds.
    """
    batch, size = probabilities.shape
    counts = np.full((batch, 1), shots, dtype=np.int64)
    while counts.shape[1] < size:
        halves = probabilities.reshape(batch, counts.shape[1] * 2, -1).sum(-1).reshape(batch, -1, 2)
        total = halves.sum(-1)
        zero = np.divide(halves[..., 0], total, out=np.zeros_like(total), where=total > 0)
        first = random.binomial(counts, np.clip(zero, 0, 1))
        counts = np.stack([first, counts - first], -1).reshape(batch, -1)
    return counts
