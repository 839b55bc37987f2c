"""The cost model behind `method="auto"`: what each engine would cost for a batch, and which one to take.

Operations are multiply-adds on one sample, counted from the program of the circuit. A light-cone polynomial needs few
operations a sample, but its circuit has to be evaluated on a grid once a step. It is cheaper from some batch size on;
with large cones it never is. Both engines work on whole vectors, so the choice does not depend on their width.

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

from qnerf.quantum import statevector
from qnerf.quantum.circuit import Circuit, readable_bytes
from qnerf.quantum.compiled.engine import work_bytes
from qnerf.quantum.cones import TooLarge, find_cones
from qnerf.quantum.lightcone import interpolation, polynomial_form
from qnerf.quantum.program import program

OVERHEAD = (
    4e7  # bytes that are multiplied and added while Python calls the loops of a second engine: half a millisecond
)


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
def lightcone_operations(circuit: Circuit) -> tuple[int, int] | TooLarge:
    """Multiply-adds for each sample, and once a step for the coefficients, forward and backward.

    The error is returned, not raised, so that it is cached too.
    """
    try:
        cones = find_cones(program(circuit))
        polynomials, points = polynomial_form(cones), len(interpolation(cones).points)
    except TooLarge as error:
        return error
    forward = backward = 0
    for cone in polynomials.cones.cones:
        terms = cone.coefficients
        for degree in reversed(cone.degrees):
            forward += terms
            backward += 4 * terms
            terms //= 2 * degree + 1
    once = points * program(circuit).operations
    return 2 * (forward + 8 * polynomials.highest_degree * (circuit.features or 0)) + backward, once


def choose_engine(circuit: Circuit, method: str, batch: int, dtype: torch.dtype, compiled: bool) -> Cost:
    """The cheaper engine for a batch of a circuit if `method` is auto, else the one asked for.

    Raises:
        TooLarge: `method` is lightcone and the circuit has no small light cones.
    """
    backend = "compiled" if compiled else "torch"
    state = program(circuit).operations
    counted = lightcone_operations(circuit) if method != "statevector" else TooLarge("asked for")
    if isinstance(counted, TooLarge):
        if method == "lightcone":
            raise TooLarge(str(counted))
        why_not = str(counted)
    else:
        cone, once = counted
        is_cheaper = cone * batch * dtype.itemsize + once * 8 + OVERHEAD < state * batch * dtype.itemsize
        if method == "lightcone" or is_cheaper:
            cones, features = find_cones(program(circuit)), circuit.features or 0
            basis = 2 * (2 * polynomial_form(cones).highest_degree + 1) * features
            memory = 8 * interpolation(cones).matrix.size + dtype.itemsize * batch * basis
            reason = "asked for" if method == "lightcone" else f"{cone:,} operations a sample instead of {state:,}"
            return Cost("lightcone", backend, batch, cone, once, memory, reason)
        why_not = f"a polynomial takes {cone:,} operations a sample, but {once:,} once a step"
    memory = work_bytes(program(circuit), batch, dtype.itemsize) if compiled else statevector.CHUNK_BYTES
    return Cost("statevector", backend, batch, state, 0, memory, why_not)
