"""State-vector simulation in plain PyTorch: any description, any device, the reference of the compiled engine.

The state is complex (2^n, B), amplitudes first. Until the first encoding B is 1: that part is done once a step.
Diagonals are one complex product, a layer of RY a few real matrix products on groups of wires. Large batches go
through in chunks that are recomputed in the backward pass, so that peak memory does not grow with the batch.
"""

from collections.abc import Sequence
from functools import lru_cache
from math import frexp

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from qnerf.quantum.normal_form import Angles, Permute, Phase, Program, Turn, parities, signs, sources

GROUP = 4  # wires in one dense real matrix
TAPE_BYTES = 2**28  # what autograd may keep of one chunk


def stacked(weights1: Tensor, weights2: Tensor) -> Tensor:
    """(S, L, n, 3) and (L, n, 3) -> (rows, 3, n)."""
    n = weights2.shape[-2]
    return torch.cat([weights1.reshape(-1, n, 3), weights2.reshape(-1, n, 3)]).transpose(1, 2)


def evaluate(program: Program, x: Tensor, weights: Tensor) -> Tensor:
    """Expectation values (B, outputs) for inputs x (B, n) in radians and stacked weights (rows, 3, n)."""
    size = chunk_size(program, x.element_size())
    if x.shape[0] <= size:
        return _expectations(program, x, weights)
    if not torch.is_grad_enabled() or not (x.requires_grad or weights.requires_grad):
        return torch.cat([_expectations(program, part, weights) for part in x.split(size)])
    parts = [
        checkpoint(_expectations, program, part, weights, use_reentrant=False, preserve_rng_state=False)
        for part in x.split(size)
    ]
    return torch.cat(parts)


def chunk_size(program: Program, item: int) -> int:
    """Samples whose tape stays below TAPE_BYTES."""
    kept = 3 * (len(program.steps) - program.fixed_steps + 1)
    return max(1, TAPE_BYTES // (kept * 2 * item * 2**program.wires))


def probabilities(program: Program, x: Tensor, weights: Tensor) -> Tensor:
    """Probabilities (B, 2^n) of the measured bit strings; wire 0 is the most significant bit."""
    state = final_state(program, x, weights)
    return (state.real.square() + state.imag.square()).T


def final_state(program: Program, x: Tensor, weights: Tensor) -> Tensor:
    """State (2^n, B) before measuring Z, up to phases of the amplitudes."""
    state = torch.zeros(2**program.wires, 1, dtype=x.dtype.to_complex(), device=x.device)
    state[0] = 1
    weights = weights.double()  # angles are added up before they are rounded
    for step in program.steps:
        if isinstance(step, Phase):
            state = state * _diagonal(step, x, weights)
        elif isinstance(step, Turn):
            state = _turn(state, *_half(step.angles, x, weights))
        else:
            state = state[_sources(step, program.wires, x.device)]
    return state.expand(-1, x.shape[0])


def _expectations(program: Program, x: Tensor, weights: Tensor) -> Tensor:
    state = final_state(program, x, weights)
    table = _parities(program.words, program.wires, x.dtype, x.device)
    values = (table @ (state.real.square() + state.imag.square())).T
    return values + (values.clamp(-1, 1) - values).detach()  # rounding may lead beyond; gradients pass as they are


def waves(x: Tensor, factors: Sequence[float]) -> tuple[Tensor, Tensor]:
    """cos and sin (n, B) of the inputs x (B, n) in radians times a factor for each wire.

    Products that the inputs' dtype would round are taken in float64: of an angle of 1e3 an error of 1e-4 would be left.
    """
    exact = all(abs(frexp(factor)[0]) in (0, 0.5) for factor in factors)
    angles = (x if exact else x.double()).T
    angles = angles * angles.new_tensor(factors)[:, None]
    return angles.cos().to(x.dtype), angles.sin().to(x.dtype)


def _half(angles: Angles, x: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """cos and sin of half the angles: (n, 1), or (n, B) where the input takes part. weights: float64.

    The input's part is not added to the fixed one: of a large input and a small weight the sum would lose the weight.
    """
    total = weights.new_zeros(x.shape[1])
    for row, kind in angles.entries:
        total = total + weights[row, kind]
    if angles.constant is not None:
        total = total + total.new_tensor(angles.constant)
    half = total[:, None] / 2
    c, s = half.cos().to(x.dtype), half.sin().to(x.dtype)
    if angles.scales is None:
        return c, s
    u, v = waves(x, [scale / 2 for scale in angles.scales])
    return c * u - s * v, s * u + c * v


def _diagonal(step: Phase, x: Tensor, weights: Tensor) -> Tensor:
    sign = _signs(step.pairs, x.shape[1], x.dtype, x.device)[:, None]
    if step.angles == Angles():
        return sign
    cosine, sine = _half(step.angles, x, weights)
    factors = torch.complex(cosine, -sine)  # of bit 0; bit 1 has the conjugate
    table = torch.stack([factors[0], factors[0].conj()])
    for factor in factors[1:]:
        table = torch.stack([table * factor, table * factor.conj()], dim=1).flatten(0, 1)
    return table * sign


def _turn(state: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
    if cosine.shape[1] != 1:
        return _turn_each(state, cosine, sine)
    pairs = torch.view_as_real(state.contiguous())
    for first in range(0, len(cosine), GROUP):
        group = range(first, min(first + GROUP, len(cosine)))
        matrix = torch.ones(1, 1, dtype=cosine.dtype, device=cosine.device)
        for wire in group:
            c, s = cosine[wire, 0], sine[wire, 0]
            matrix = torch.kron(matrix, torch.stack([torch.stack([c, -s]), torch.stack([s, c])]))
        view = pairs.reshape(2**first, 2 ** len(group), -1)
        pairs = torch.matmul(matrix, view).reshape(pairs.shape)
    return torch.view_as_complex(pairs)


def _turn_each(state: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
    """RY with another angle for each sample."""
    state = state.expand(-1, cosine.shape[1])
    shape = state.shape
    for wire in range(len(cosine)):
        view = state.reshape(2**wire, 2, shape[0] >> wire + 1, shape[1])
        zero, one = view[:, 0], view[:, 1]
        c, s = cosine[wire], sine[wire]
        state = torch.stack([c * zero - s * one, s * zero + c * one], dim=1).reshape(shape)
    return state


@lru_cache(maxsize=512)
def _signs(pairs: tuple[tuple[int, int], ...], wires: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.from_numpy(signs(pairs, wires)).to(device, dtype)


@lru_cache(maxsize=64)
def _parities(words: tuple[frozenset[int], ...], wires: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.from_numpy(parities(words, wires)).to(device, dtype)


@lru_cache(maxsize=64)
def _sources(step: Permute, wires: int, device: torch.device) -> Tensor:
    return torch.from_numpy(sources(step, wires)).to(device)
