"""A circuit measured as hardware would: finitely many shots, noisy gates. Outputs carry no gradients."""

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from qnerf.quantum import density, statevector
from qnerf.quantum.circuit import Circuit
from qnerf.quantum.normal_form import compile_program, parities
from qnerf.quantum.pennylane import Noise

CHUNK = 4096


@dataclass
class Conditions:
    """How a circuit is measured.

    shots   measurements of each circuit; None: exact expectation values
    noise   channels behind every gate; None: none
    joint   True: every shot reads all wires at once, as a device does. False: each output is an independent binomial
            with its exact probability. Every output alone has the same distribution either way, only correlations
            between outputs of one sample differ; False is faster. Noisy shots are always independent.
    """

    shots: int | None = None
    noise: Noise | None = None
    joint: bool = True
    seed: int = 0
    random: np.random.Generator = field(init=False, repr=False)
    tables: dict[bytes, Tensor] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        if self.shots is not None and (
            isinstance(self.shots, bool) or not isinstance(self.shots, int) or self.shots < 1
        ):
            raise ValueError(f"shots expects a positive integer or None, got {self.shots!r}")
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


@torch.no_grad()
def measure(circuit: Circuit, x: Tensor, weights: Tensor, exact: Tensor | None, given: Conditions) -> Tensor:
    """Outputs (B, outputs) for x (B, n) and stacked weights (rows, 3, n); `exact`: expectation values if already
    known.
    """
    if given.noise is not None and given.noisy:
        exact = density.evaluate(circuit, x, weights, given.noise, given.tables)
    if given.shots is None:
        assert exact is not None
        return exact
    if given.joint and not given.noisy:
        return torch.cat([_joint(circuit, part, weights, given) for part in x.split(CHUNK)])
    assert exact is not None
    return binomial(exact, given.shots, given.random)


def binomial(exact: Tensor, shots: int, random: np.random.Generator) -> Tensor:
    """Means of `shots` independent +1 or -1 with expectation `exact`; NaN stays NaN."""
    values = exact.detach().double().cpu().numpy()
    up = random.binomial(shots, np.clip(np.nan_to_num((1 + values) / 2), 0, 1))
    means = np.where(np.isnan(values), np.nan, 2 * up / shots - 1)
    return torch.from_numpy(means).to(exact)


def _joint(circuit: Circuit, x: Tensor, weights: Tensor, given: Conditions) -> Tensor:
    program = compile_program(circuit)
    assert given.shots is not None
    chances = statevector.probabilities(program, x.double(), weights.double()).cpu().numpy()
    if not len(chances):
        return x.new_zeros(0, len(circuit.observables))
    counts = multinomial(given.shots, np.nan_to_num(chances), given.random)
    means = counts @ parities(program.words, program.wires).T / given.shots
    means[np.isnan(chances).any(1)] = np.nan
    return torch.from_numpy(means).to(x)


def multinomial(shots: int, chances: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Counts (B, 2^n) of `shots` draws from each row: wire after wire, a binomial among those that agree so far."""
    batch, size = chances.shape
    counts = np.full((batch, 1), shots, dtype=np.int64)
    while counts.shape[1] < size:
        halves = chances.reshape(batch, counts.shape[1] * 2, -1).sum(-1).reshape(batch, -1, 2)
        total = halves.sum(-1)
        zero = np.divide(halves[..., 0], total, out=np.zeros_like(total), where=total > 0)
        first = random.binomial(counts, np.clip(zero, 0, 1))
        counts = np.stack([first, counts - first], -1).reshape(batch, -1)
    return counts
