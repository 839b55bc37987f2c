"""State-vector simulation in plain PyTorch: any description, any device, the reference of the compiled engine.

The state is complex (2^n, B), amplitudes first. Until the first encoding B is 1: that part is done once a step.
Diagonals are one complex product, a layer of RY a few real matrix products on groups of wires. Large batches go
through in chunks that are recomputed in the backward pass, so that peak memory does not grow with the batch.
"""

from functools import lru_cache

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from qnerf.quantum.program import Angles, Permute, Phase, Program, Turn, parities, signs, sources

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
    for step in program.steps:
        if isinstance(step, Phase):
            state = state * _diagonal(step, x, weights)
        elif isinstance(step, Turn):
            state = _turn(state, _angles(step.angles, x, weights))
        else:
            state = state[_sources(step, program.wires, x.device)]
    return state.expand(-1, x.shape[0])


def _expectations(program: Program, x: Tensor, weights: Tensor) -> Tensor:
    state = final_state(program, x, weights)
    table = _parities(program.words, program.wires, x.dtype, x.device)
    return (table @ (state.real.square() + state.imag.square())).T


def _angles(angles: Angles, x: Tensor, weights: Tensor) -> Tensor:
    """(n, 1), or (n, B) where the input takes part."""
    total = x.new_zeros(x.shape[1])
    for row, kind in angles.entries:
        total = total + weights[row, kind]
    if angles.constant is not None:
        total = total + x.new_tensor(angles.constant)
    if angles.scales is None:
        return total[:, None]
    return total[:, None] + x.T * x.new_tensor(angles.scales)[:, None]


def _diagonal(step: Phase, x: Tensor, weights: Tensor) -> Tensor:
    sign = _signs(step.pairs, x.shape[1], x.dtype, x.device)[:, None]
    if step.angles == Angles():
        return sign
    half = _angles(step.angles, x, weights) / 2
    factors = torch.complex(half.cos(), -half.sin())  # of bit 0; bit 1 has the conjugate
    table = torch.stack([factors[0], factors[0].conj()])
    for factor in factors[1:]:
        table = torch.stack([table * factor, table * factor.conj()], dim=1).flatten(0, 1)
    return table * sign


def _turn(state: Tensor, angles: Tensor) -> Tensor:
    if angles.shape[1] > 1:
        return _turn_each(state, angles)
    pairs = torch.view_as_real(state.contiguous())
    half = angles[:, 0] / 2
    for first in range(0, len(half), GROUP):
        group = half[first : first + GROUP]
        matrix = torch.ones(1, 1, dtype=half.dtype, device=half.device)
        for angle in group:
            c, s = angle.cos(), angle.sin()
            matrix = torch.kron(matrix, torch.stack([torch.stack([c, -s]), torch.stack([s, c])]))
        view = pairs.reshape(2**first, 2 ** len(group), -1)
        pairs = torch.matmul(matrix, view).reshape(pairs.shape)
    return torch.view_as_complex(pairs)


def _turn_each(state: Tensor, angles: Tensor) -> Tensor:
    """RY with another angle for each sample."""
    state = state.expand(-1, angles.shape[1])
    shape = state.shape
    cosine, sine = (angles / 2).cos(), (angles / 2).sin()
    for wire in range(len(angles)):
        view = state.reshape(2**wire, 2, -1, shape[1])
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
