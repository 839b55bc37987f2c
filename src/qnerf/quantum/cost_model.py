"""The cost model behind `method="auto"`: what each engine would cost for a batch, and which one to take.

Operations are multiply-adds on one sample, counted from the normal form of the circuit. A light-cone polynomial needs
few operations a sample, but its circuit has to be evaluated on a grid once a step. It is cheaper from some batch size
on; with large cones it never is. Both engines work on whole vectors, so the choice does not depend on their width.

>>> from qnerf.quantum.circuit import ANSATZE
>>> for spectral in (1, 2):
...     circuit = ANSATZE.build("qiren", 8, spectral)
...     print(choose_engine(circuit, "auto", 6144, torch.float32, compiled=True).method)
lightcone
statevector
"""

from dataclasses import dataclass
from functools import lru_cache

import torch

from qnerf.kernels.jit import loop_threads
from qnerf.kernels.simd import VECTOR_BYTES
from qnerf.quantum import statevector
from qnerf.quantum.circuit import Circuit, readable_bytes
from qnerf.quantum.cones import TooLarge
from qnerf.quantum.lightcone import interpolation, polynomial_form
from qnerf.quantum.normal_form import CNOTs, Diagonal, NormalForm, normal_form


@dataclass(frozen=True)
class Cost:
    """The engine that a layer takes for a batch, and what a step costs: forward and backward together.

    Attributes:
        method: lightcone, statevector or pennylane.
        backend: compiled or torch.
        batch: samples.
        operations: multiply-adds for each sample.
        operations_once: multiply-adds for each step, whatever the batch.
        memory: bytes of work space beside inputs and outputs.
        reason: why this engine was taken, and not another one.
    """

    method: str
    backend: str
    batch: int
    operations: int
    operations_once: int
    memory: int
    reason: str

    def __str__(self) -> str:
        return (
            f"{self.method} ({self.backend}) for {self.batch} samples: {self.operations:,} operations a sample, "
            f"{self.operations_once:,} a step, {readable_bytes(self.memory)}; {self.reason}"
        )


@lru_cache(maxsize=256)
def statevector_operations(form: NormalForm) -> int:
    """Multiply-adds for each sample, forward and backward, of the compiled state-vector engine."""
    n = form.wires
    size = 2**n
    forward, backward = 4 * size, 0  # the input's phases
    steps = form.steps[form.fixed_steps : len(form.steps) - (1 if form.measures_last_layer else 0)]
    for step in steps:
        if isinstance(step, Diagonal):
            each = 8 if step.angles.scales is not None else 4
            forward += each * size
            backward += (each + 5) * size
        elif isinstance(step, CNOTs):
            forward += size
            backward += 2 * size
        else:
            forward += 2 * n * size
            backward += 4 * n * size
    measurement = (n + 5) * size if form.measures_last_layer else (len(form.measured) + 2) * size
    backward += (2 * n + 4) * size if form.measures_last_layer else (2 * len(form.measured) + 2) * size
    return 2 * forward + measurement + backward  # the backward pass runs the forward pass again


def statevector_memory(form: NormalForm, batch: int, itemsize: int = 4) -> int:
    """Bytes of work space, at most, of the compiled state-vector engine: a block of samples for each thread."""
    blocks = -(-batch * itemsize // VECTOR_BYTES)
    vectors = 2 * (len(form.steps) + 2) + 10
    blocks_at_once = min(loop_threads(), blocks)
    return blocks_at_once * vectors * 2**form.wires * VECTOR_BYTES + itemsize * batch * 4 * form.wires


@lru_cache(maxsize=256)
def lightcone_operations(circuit: Circuit) -> tuple[int, int] | TooLarge:
    """Multiply-adds for each sample, and once a step for the coefficients, forward and backward.

    The error is returned, not raised, so that it is cached too.
    """
    try:
        polynomials, points = polynomial_form(circuit), len(interpolation(circuit).points)
    except TooLarge as error:
        return error
    forward = backward = 0
    for cone in polynomials.cones.cones:
        terms = cone.coefficients
        for degree in reversed(cone.degrees):
            forward += terms
            backward += 4 * terms
            terms //= 2 * degree + 1
    once = points * statevector_operations(normal_form(circuit))
    return 2 * (forward + 8 * polynomials.highest_degree * circuit.wires) + backward, once


def choose_engine(circuit: Circuit, method: str, batch: int, dtype: torch.dtype, compiled: bool) -> Cost:
    """The cheaper engine for a batch of a re-uploading circuit if `method` is auto, else the one asked for.

    Raises:
        TooLarge: `method` is lightcone and the circuit has no small light cones.
    """
    form = normal_form(circuit)
    itemsize = torch.finfo(dtype).bits // 8
    backend = "compiled" if compiled else "torch"
    state, counted = statevector_operations(form), lightcone_operations(circuit)
    if isinstance(counted, TooLarge):
        if method == "lightcone":
            raise TooLarge(str(counted))
        why_not = str(counted)
    else:
        cone, once = counted
        is_cheaper = cone * batch * itemsize + once * 8 < state * batch * itemsize
        if method == "lightcone" or (method == "auto" and is_cheaper):
            degree = polynomial_form(circuit).highest_degree
            memory = 8 * interpolation(circuit).matrix.size + itemsize * batch * 2 * (2 * degree + 1) * circuit.wires
            reason = "asked for" if method == "lightcone" else f"{cone:,} operations a sample instead of {state:,}"
            return Cost("lightcone", backend, batch, cone, once, memory, reason)
        why_not = f"a polynomial takes {cone:,} operations a sample, but {once:,} once a step"
    memory = statevector_memory(form, batch, itemsize) if compiled else statevector.CHUNK_BYTES
    return Cost("statevector", backend, batch, state, 0, memory, "asked for" if method == "statevector" else why_not)
