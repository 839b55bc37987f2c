"""Circuits measured as on hardware: with finitely many shots or noisy gates."""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from qnerf.config.bounds import PositiveInt, check
from qnerf.kernels import is_transformed
from qnerf.quantum import density, pauli_errors
from qnerf.quantum.circuit import Circuit
from qnerf.quantum.noise import Noise
from qnerf.quantum.pauli_errors import Exact
from qnerf.quantum.program import Program, unmerged
from qnerf.quantum.readout import as_read
from qnerf.quantum.simulator import simulator_of

NoiseMethod = Literal["auto", "density", "sampled"]


@dataclass
class Conditions:
    """How a circuit is measured.

    Args:
        shots: measurements of each Pauli word and of each of the `Probabilities`, independent of the others; None for
            exact expectation values.
        noise: errors of the gates and of the readout; None: no errors.
        seed: of the shots and of sampled noise; None draws from torch's global generator.
        method: of noisy gates. density is exact, by density matrices; sampled draws `patterns` of Pauli errors, with a
            standard error; auto takes density where it is quick (`density.is_quick`).
        patterns: drawn for each call of a circuit. All its samples share them.
        gradients: False makes a backward pass through the outputs a ValueError. With True they have the derivatives of
            the exact values, or with noise of the drawn patterns (never density matrices). Values of shots are
            sampled, their derivatives are not: d loss / d value is taken at the sampled value. The parameter-shift rule
            with shots of its own has this expectation, and more variance.

    Raises:
        ValueError: `shots` or `patterns` is not a positive integer, `method` is unknown, or `noise` is not a `Noise`.
    """

    shots: int | None = None
    noise: Noise | None = None
    seed: int | None = 0
    method: NoiseMethod = "auto"
    patterns: int = 100
    gradients: bool = False
    random: np.random.Generator = field(init=False, repr=False)
    noisy_coefficients: dict[bytes, Tensor] = field(init=False, repr=False, default_factory=dict)
    squared_errors: float = field(init=False, repr=False, default=0.0)
    outputs: int = field(init=False, repr=False, default=0)

    def __post_init__(self) -> None:
        for name, kind in (
            ("shots", PositiveInt | None), ("noise", Noise | None), ("method", NoiseMethod), ("patterns", PositiveInt),
        ):  # fmt: skip
            check(name, getattr(self, name), kind)
        if self.seed is not None:
            self.random = np.random.default_rng(self.seed)

    @property
    def noisy(self) -> bool:
        return self.noise is not None and self.noise.any

    @property
    def standard_error(self) -> float:
        """Root mean square of the standard errors of all outputs so far, from sampled noise alone.

        0 where noise is exact, and with gradients=True.
        """
        return (self.squared_errors / self.outputs) ** 0.5 if self.outputs else 0.0

    def is_sampled(self, circuit: Circuit) -> bool:
        """Whether the gate noise of this circuit is sampled rather than exact."""
        if self.noise is None or not self.noise.gates:
            return False
        slow = self.method == "auto" and not density.is_quick(circuit)
        return self.gradients or self.method == "sampled" or slow


class _WithoutGradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, *sources: Tensor) -> Tensor:
        return values.view_as(values)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        raise ValueError("outputs under hardware conditions carry no gradients; train outside the conditions")


def measure(circuit: Circuit, x: Tensor, weights: Tensor, exact: Exact, conditions: Conditions) -> Tensor:
    """Outputs (B, outputs) for x (B, features) and flat weights. `exact` computes the exact outputs.

    See `Conditions` for derivatives.
    """
    if conditions.seed is None:
        conditions.random = np.random.default_rng(int(torch.randint(2**62, ())))
    found = unmerged(circuit)
    if not found.read or (conditions.shots is None and not conditions.noisy):
        out = exact(x, weights)
        return out if conditions.gradients or is_transformed(x, weights) else _without_gradient(out, x, weights)
    if is_transformed(x, weights):
        raise ValueError("shots and noise: torch.func and forward-mode differentiation need exact outputs")
    if conditions.gradients:
        values = _expected(circuit, found, x, weights, exact, conditions)
        with torch.no_grad():
            drawn = _drawn(found, values, conditions)
        return found.outputs(values if drawn is values else values + (drawn - values).detach())
    with torch.no_grad():
        values = _expected(circuit, found, x, weights, exact, conditions)
        drawn = _drawn(found, values, conditions)
    return _without_gradient(found.outputs(drawn), x, weights)


def _without_gradient(out: Tensor, x: Tensor, weights: Tensor) -> Tensor:
    without: Tensor = _WithoutGradient.apply(out.detach(), x, weights)
    return without


def _expected(
    circuit: Circuit, found: Program, x: Tensor, weights: Tensor, exact: Exact, conditions: Conditions
) -> Tensor:
    """The exact values (B, values), with the errors of gates and of the readout."""
    noise = conditions.noise or Noise()
    own = replace(circuit, observables=found.read)
    if own.observables != circuit.observables:
        exact = simulator_of(own)
    if conditions.is_sampled(own):
        final = lambda values: found.outputs(as_read(found, values, noise))  # noqa: E731
        values, errors = pauli_errors.evaluate(
            exact, own, x, weights, noise, conditions.patterns, conditions.random, final
        )
        if not conditions.gradients:  # reading the number would make a GPU wait
            conditions.squared_errors += float(errors.square().sum())
            conditions.outputs += errors.numel()
    elif noise.gates:
        values = density.evaluate(own, x, weights, noise, conditions.noisy_coefficients)
    else:
        values = exact(x, weights)
    return as_read(found, values, noise)


def _drawn(found: Program, expected: Tensor, conditions: Conditions) -> Tensor:
    """Values that are means of finitely many shots; `expected` itself without a number of shots."""
    shots = conditions.shots
    if shots is None:
        return expected
    drawn = torch.empty_like(expected)
    first = len(found.words)
    drawn[:, :first] = binomial(expected[:, :first], shots, conditions.random)
    for size in found.outcomes:
        table = slice(first, first := first + size)
        exact = expected[:, table].detach()
        chances = np.clip(np.nan_to_num(exact.double().cpu().numpy()), 0, 1)
        counts = conditions.random.multinomial(shots, chances / np.maximum(chances.sum(1, keepdims=True), 1))
        drawn[:, table] = torch.from_numpy(counts / shots).to(expected).where(exact == exact, torch.nan)
    return drawn


def binomial(exact: Tensor, shots: int, random: np.random.Generator) -> Tensor:
    """Means of `shots` independent +1 or -1 with expectation `exact`; NaN stays NaN."""
    values = exact.detach().double().cpu().numpy()
    up = random.binomial(shots, np.clip(np.nan_to_num((1 + values) / 2), 0, 1))
    means = np.where(np.isnan(values), np.nan, 2 * up / shots - 1)
    return torch.from_numpy(means).to(exact)
