"""What a batch of any circuit costs in Pauli form: operations, memory, and the time of a step.

The expected time has seven constants, which were fitted to five kinds of circuits
(benchmarks/results/cost_model_any.parquet). On these the time of a step is within a factor of 2.
"""

from dataclasses import dataclass

import torch

from qnerf.kernels.jit import loop_threads
from qnerf.kernels.simd import VECTOR_BYTES
from qnerf.quantum import statevector
from qnerf.quantum.circuit import Expression
from qnerf.quantum.cost_model import Cost
from qnerf.quantum.pauli_form import PauliForm


@dataclass(frozen=True)
class PauliRates:
    """How fast the machine is.

    Attributes:
        step: seconds of every step: Python, autograd.
        once: seconds for each amplitude and rotation that runs once a step.
        angle: seconds for each sample and each factor of an angle that moves with the input.
        turn: seconds for each sample and rotation: cosines and sines.
        value: seconds for each sample and measured value.
        start: seconds for each sample and amplitude of a start that moves with the input.
        state: bytes of multiply-add operands a second, thread and byte of a vector.
    """

    step: float = 0.000585
    once: float = 9.26e-09
    angle: float = 1.79e-08
    turn: float = 1.2e-08
    value: float = 8.22e-09
    start: float = 5.57e-08
    state: float = 2.15e09


RATES = PauliRates()


def operations(form: PauliForm) -> int:
    """Multiply-adds for each sample, forward and backward."""
    size, moving = 2**form.wires, len(form.rotations) - form.fixed_rotations
    return size * (
        4 * moving + 3 * len(form.words) + 4 * moving + 11 * moving + 4 * len(form.words) + 8 * len(form.tables)
    )


def memory_bytes(form: PauliForm, batch: int, itemsize: int = 4) -> int:
    """Bytes of work space, at most: three states of a block of samples for each thread, angles, starts."""
    blocks = -(-batch * itemsize // VECTOR_BYTES)
    states = 6 * min(loop_threads(), blocks) + (5 * blocks if form.start else 0)
    values = len(form.words) + form.outcomes + 6 * len(form.rotations)
    parts = 2 * 8 * min(32, blocks) * 2**form.wires
    return (states * 2**form.wires + blocks * values) * VECTOR_BYTES + parts


def expected_seconds(form: PauliForm, batch: int, itemsize: int, rates: PauliRates = RATES) -> float:
    """Forward and backward of the compiled engine."""
    size, lanes = 2**form.wires, VECTOR_BYTES // itemsize
    blocks = -(-batch // lanes)  # one sample costs as much as a block
    threads = min(loop_threads(), max(blocks, 1))
    moving = [rotation.angle for rotation in form.rotations if rotation.angle.features]
    factors = sum(1 + len(features) for angle in moving for _, _, features in angle.terms)
    starts = [Expression.of(angle) for part in form.start for angle in part.angles]
    amplitudes = size if any(angle.features for angle in starts) else 0
    turns, values = len(form.rotations) - form.fixed_rotations, len(form.words) + form.outcomes
    sample = rates.angle * factors + rates.turn * turns + rates.value * values + rates.start * amplitudes
    state = operations(form) * blocks * lanes * itemsize / (rates.state * VECTOR_BYTES * threads)
    return rates.step + rates.once * form.fixed_rotations * size + sample * batch + state


def cost(form: PauliForm, batch: int, dtype: torch.dtype, compiled: bool) -> Cost:
    """What a batch costs, forward and backward."""
    itemsize = torch.finfo(dtype).bits // 8
    seconds = expected_seconds(form, batch, itemsize) if compiled else float("nan")
    needed = memory_bytes(form, batch, itemsize) if compiled else statevector.CHUNK_BYTES
    reason = f"{len(form.rotations)} rotations about Pauli words"
    backend = "compiled" if compiled else "torch"
    return Cost("statevector", backend, batch, operations(form), 0, needed, seconds, reason)
