"""Which engine, and what it will cost: the cost model behind `method="auto"`.

Operations are multiply-adds on one sample, counted from the normal form of the circuit. The compiled engines reach a
fixed rate of them (RATE, measured on one core with 512-bit vectors; half of that with 256 bits), plus a fixed overhead
a step. A light-cone polynomial needs few operations a sample but an exact evaluation on its grid each step, so that
it wins from some batch size on; with large cones it never does.
"""

from dataclasses import dataclass, field
from functools import lru_cache

import torch

from qnerf.quantum.circuit import Circuit, readable_bytes
from qnerf.quantum.compiled.simd import VECTOR_BYTES
from qnerf.quantum.cones import TooLarge
from qnerf.quantum.lightcone import interpolation
from qnerf.quantum.normal_form import Permute, Phase, Program
from qnerf.quantum.statevector import TAPE_BYTES

RATE = (
    5e9 * VECTOR_BYTES
)  # bytes of multiply-add operands a second and thread: 8e10 float32 operations with 64-byte vectors
OVERHEAD = 3e-4  # seconds a step: Python, autograd, binding the weights


@dataclass(frozen=True)
class Plan:
    """What `QuantumLayer.plan` tells. Operations are multiply-adds, forward and backward together."""

    method: str
    backend: str  # compiled or torch
    batch: int
    operations: int  # a sample
    operations_once: int  # a step, whatever the batch
    memory: int  # bytes of work space beside inputs and outputs
    seconds: float  # expected; nan where no rate was measured (GPUs, plain PyTorch, PennyLane)
    reason: str
    others: dict[str, str] = field(default_factory=dict)  # methods not taken, and why

    def __str__(self) -> str:
        time = f", about {self.seconds * 1e3:.2f} ms" if self.seconds == self.seconds else ""
        return (
            f"{self.method} ({self.backend}) for {self.batch} samples: {self.operations:,} operations a sample, "
            f"{self.operations_once:,} a step, {readable_bytes(self.memory)}{time}; {self.reason}"
        )


def statevector_operations(program: Program) -> int:
    """Multiply-adds a sample, forward + backward of the compiled engine."""
    n = program.wires
    size = 2**n
    forward, pull = 4 * size, 0  # the input's phases
    steps = program.steps[program.fixed_steps : len(program.steps) - (1 if program.local else 0)]
    for step in steps:
        if isinstance(step, Phase):
            each = 8 if step.angles.scales is not None else 4
            forward += each * size
            pull += (each + 5) * size
        elif isinstance(step, Permute):
            forward += size
            pull += 2 * size
        else:
            each = 4 if step.angles.scales is not None else 2
            forward += each * n * size
            pull += (each + 2) * n * size
    measure = (n + 5) * size if program.local else (len(program.words) + 2) * size
    pull += (2 * n + 4) * size if program.local else (2 * len(program.words) + 2) * size
    return 2 * forward + measure + pull


@lru_cache(maxsize=256)
def lightcone_operations(circuit: Circuit) -> tuple[int, int] | str:
    """Multiply-adds a sample, forward + backward, and circuits a step; or, where cones are too large, how large."""
    try:
        grid = interpolation(circuit)
    except TooLarge as error:
        return str(error)
    forward = backward = 0
    for cone in grid.cones.cones:
        terms = cone.coefficients
        for degree in reversed(cone.degrees):
            forward += terms
            backward += 4 * terms
            terms //= 2 * degree + 1
    return 2 * (forward + 8 * grid.most * circuit.wires) + backward, len(grid.points)


def make_plan(circuit: Circuit, program: Program, method: str, batch: int, dtype: torch.dtype, compiled: bool) -> Plan:
    """The engine for a batch. TooLarge if `method` is lightcone and the circuit has no small light cones."""
    item = torch.finfo(dtype).bits // 8
    threads = torch.get_num_threads()
    backend = "compiled" if compiled else "torch"
    rate = RATE * threads

    def seconds(operations: int, once: int) -> float:
        return OVERHEAD + (operations * batch * item + once * 8) / rate if compiled else float("nan")

    state = statevector_operations(program)
    found = lightcone_operations(circuit)
    if isinstance(found, str):
        if method == "lightcone":
            raise TooLarge(found)
        why = found
    else:
        cone, once = found[0], found[1] * state
        if method == "lightcone" or (method == "auto" and cone * batch * item + once * 8 < state * batch * item):
            others = {"statevector": f"{state:,} operations a sample, none once a step"}
            grid = interpolation(circuit)
            memory = 8 * grid.matrix.size + item * batch * 2 * (2 * grid.most + 1) * circuit.wires
            reason = "asked for" if method == "lightcone" else f"{cone:,} operations a sample instead of {state:,}"
            return Plan("lightcone", backend, batch, cone, once, memory, seconds(cone, once), reason, others)
        why = f"{cone:,} operations a sample, but {once:,} once a step"
    if compiled:
        kept = 2 * (len(program.steps) + 2) + 10
        memory = threads * kept * 2**circuit.wires * VECTOR_BYTES + item * batch * 4 * circuit.wires
    else:
        memory = TAPE_BYTES
    reason = "asked for" if method == "statevector" else why
    return Plan("statevector", backend, batch, state, 0, memory, seconds(state, 0), reason, {"lightcone": why})
