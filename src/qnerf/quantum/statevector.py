"""State-vector simulation in plain PyTorch: any circuit, any device. It is the reference of the compiled engine.

The state is complex (2^n, B), amplitudes first. Up to the first encoding B is 1, so that part runs once for the whole
batch. A diagonal is one complex product; a layer of RY is a few real matrix products on groups of wires. Large batches
go through in chunks that are computed again in the backward pass, so that peak memory does not grow with the batch.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from math import frexp
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from qnerf.kernels import is_transformed
from qnerf.quantum.circuit import check_state
from qnerf.quantum.normal_form import Angles, Diagonal, NormalForm, RYLayer, cnot_permutation, cz_signs, z_eigenvalues

GROUP = 4  # wires in one dense real matrix
CHUNK_BYTES = 2**28  # what autograd may store for one chunk


def evaluate(form: NormalForm, x: Tensor, weights: Tensor) -> Tensor:
    """Expectation values (B, outputs) for inputs x (B, n) in radians and flat weights (of any shape)."""
    return in_chunks(partial(_expectations, form), chunk_size(form, x.element_size()), (x,), (weights,))


def in_chunks(
    function: Callable[..., Tensor], size: int, moving: tuple[Tensor, ...], shared: tuple[Tensor, ...]
) -> Tensor:
    """`function(*moving, *shared)` for `size` samples at a time; `moving` tensors have a row for each sample.

    Where gradients are wanted, a chunk is computed again in the backward pass.
    """
    if len(moving[0]) <= size:
        return function(*moving, *shared)
    parts = zip(*(tensor.split(size) for tensor in moving), strict=True)
    tensors = *moving, *shared
    stores = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    if not stores or is_transformed(*tensors):  # `torch.func` does not know checkpoints
        return torch.cat([function(*part, *shared) for part in parts])
    options: dict[str, Any] = {"use_reentrant": False, "preserve_rng_state": False}
    return torch.cat([checkpoint(function, *part, *shared, **options) for part in parts])


def chunk_size(form: NormalForm, itemsize: int) -> int:
    """How many samples autograd can store in CHUNK_BYTES, at least 1."""
    stored_states = 3 * (len(form.steps) - form.fixed_steps + 1)
    return max(1, CHUNK_BYTES // (stored_states * 2 * itemsize * 2**form.wires))


def probabilities(form: NormalForm, x: Tensor, weights: Tensor) -> Tensor:
    """Probabilities (B, 2^n) of the measured bit strings; wire 0 is the most significant bit."""
    return _squared(final_state(form, x, weights)).T


def final_state(form: NormalForm, x: Tensor, weights: Tensor) -> Tensor:
    """The state (2^n, B) before Z is measured, up to phases of the amplitudes.

    Raises:
        ValueError: more than 20 wires.
    """
    check_state(form.wires, f"the whole state of circuit {form.circuit.name}")
    state = torch.zeros(2**form.wires, 1, dtype=x.dtype.to_complex(), device=x.device)
    state[0] = 1
    angles = weights.double().reshape(form.circuit.rows, form.wires, 3)  # added up before they are rounded
    for step in form.steps:
        if isinstance(step, Diagonal):
            state = state * _diagonal(step, x, angles)
        elif isinstance(step, RYLayer):
            state = _apply_ry(state, *_cos_sin_of_half(step.angles, x, angles))
        else:
            state = state[table(cnot_permutation, step.pairs, form.wires, x.device, None)]
    return state.expand(-1, x.shape[0])


def _squared(state: Tensor) -> Tensor:
    return state.real.square() + state.imag.square()


def _expectations(form: NormalForm, x: Tensor, weights: Tensor) -> Tensor:
    eigenvalues = table(z_eigenvalues, form.measured, form.wires, x.device, x.dtype)
    return clipped((eigenvalues @ _squared(final_state(form, x, weights))).T)


def clipped(values: Tensor) -> Tensor:
    """The values within [-1, 1], which rounding may leave; gradients pass as they are."""
    return values + (values.clamp(-1, 1) - values).detach()


def cos_sin(x: Tensor, factors: Sequence[float]) -> tuple[Tensor, Tensor]:
    """cos and sin (n, B) of the inputs x (B, n) in radians times a factor for each wire.

    A product that the dtype of the inputs would round is taken in float64: at an angle of 1e3 the rounding alone would
    be an error of 1e-4.
    """
    exact = all(abs(frexp(factor)[0]) in (0, 0.5) for factor in factors)
    angles = (x if exact else x.double()).T
    angles = angles * angles.new_tensor(factors)[:, None]
    return angles.cos().to(x.dtype), angles.sin().to(x.dtype)


def _cos_sin_of_half(angles: Angles, x: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """cos and sin of half the angles: (n, 1), or (n, B) if they depend on the input. weights: (rows, n, 3) float64.

    The input's part and the fixed part are not added up: a large input plus a small weight would round the weight away.
    """
    total = weights.new_zeros(x.shape[1])
    for row, kind in angles.weights:
        total = total + weights[row, :, kind]
    if angles.constant is not None:
        total = total + total.new_tensor(angles.constant)
    half = total[:, None] / 2
    c, s = half.cos().to(x.dtype), half.sin().to(x.dtype)
    if angles.scales is None:
        return c, s
    u, v = cos_sin(x, [scale / 2 for scale in angles.scales])
    return c * u - s * v, s * u + c * v


def _diagonal(step: Diagonal, x: Tensor, weights: Tensor) -> Tensor:
    sign = table(cz_signs, step.pairs, x.shape[1], x.device, x.dtype)[:, None]
    if step.angles == Angles():
        return sign
    cosine, sine = _cos_sin_of_half(step.angles, x, weights)
    factors = torch.complex(cosine, -sine)  # of bit 0; bit 1 has the conjugate
    phases = torch.stack([factors[0], factors[0].conj()])
    for factor in factors[1:]:
        phases = torch.stack([phases * factor, phases * factor.conj()], dim=1).flatten(0, 1)
    return phases * sign


def _apply_ry(state: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
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


@lru_cache(maxsize=1024)
@torch.inference_mode(False)  # it is kept for training, too
def table(
    build: Callable[[Any, int], np.ndarray], gates: Any, wires: int, device: torch.device, dtype: torch.dtype | None
) -> Tensor:
    """`build(gates, wires)` on a device; `dtype` None keeps its own."""
    return torch.from_numpy(build(gates, wires)).to(device, dtype)
