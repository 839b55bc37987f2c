"""A circuit ready to run: the cheapest exact engine for each batch, and wide circuits as registers."""

from functools import cached_property, lru_cache
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from qnerf.config import memory
from qnerf.kernels.dispatch import serves
from qnerf.kernels.jit import loop_threads
from qnerf.quantum.circuit import Circuit
from qnerf.quantum.cost_model import Cost
from qnerf.quantum.families import family_of
from qnerf.quantum.registers import Register, is_split, registers

Backend = Literal["auto", "compiled", "torch"]


class Simulator:
    """A circuit with the engines that it needs.

    Args:
        circuit: any.
        method: auto, lightcone or statevector, see `QuantumLayer`.
        backend: auto, compiled or torch.

    Raises:
        ValueError: a state of more than 20 wires or than memory holds, or method=lightcone without small light cones.
    """

    def __init__(self, circuit: Circuit, method: str = "auto", backend: Backend = "auto") -> None:
        self.circuit, self.method, self.backend = circuit, method, backend
        self._costs: dict[tuple[object, ...], Cost] = {}
        self._is_split = is_split(circuit)
        if self._is_split:
            _ = self.parts if method == "lightcone" else None  # an error now, not at the first batch
        else:
            self.family = family_of(circuit, method)
            memory.require(f"one sample of a circuit of {circuit.wires} wires", self.family.sample_bytes())

    @cached_property
    def parts(self) -> "list[tuple[Register, Simulator]]":
        """The registers of a wide circuit, each with its simulator."""
        found = registers(self.circuit)
        own = {c: Simulator(c, self.method, self.backend) for c in dict.fromkeys(part.circuit for part in found)}
        return [(part, own[part.circuit]) for part in found]

    def cost(self, batch: int, dtype: torch.dtype, compiled: bool) -> Cost:
        """The engine for a batch, and what a step costs. compiled: whether the compiled engines serve it.

        The method of a wide circuit is the method of its largest register.
        """
        key = batch, dtype, compiled, loop_threads()
        if key not in self._costs:
            if len(self._costs) > 1000:
                self._costs.clear()
            costs = self._cost_of_registers if self._is_split else self.family.cost
            self._costs[key] = costs(batch, dtype, compiled)
        return self._costs[key]

    def _cost_of_registers(self, batch: int, dtype: torch.dtype, compiled: bool) -> Cost:
        costs = [own.cost(batch, dtype, compiled) for _, own in self.parts]
        work = max(cost.memory for cost in costs) + 2 * batch * self.circuit.outputs * dtype.itemsize
        largest = self.parts[0][0].circuit.wires
        reason = f"{costs[0].reason}, {len(costs)} registers of at most {largest} wires"
        operations = sum(cost.operations for cost in costs), sum(cost.operations_once for cost in costs)
        return Cost(costs[0].method, costs[0].backend, batch, *operations, work, reason)

    def is_compiled(self, *tensors: Tensor) -> bool:
        """Whether the compiled engines serve these tensors.

        Raises:
            ValueError: backend=compiled, and a tensor that is not on the CPU.
        """
        if self.backend == "compiled" and tensors[0].device.type != "cpu":
            device = tensors[0].device
            raise ValueError(f"backend=compiled expects tensors on the CPU, got {device}; choose auto or torch")
        return serves("circuits", *tensors, but="backend=torch" if self.backend == "torch" else None)

    def __call__(self, x: Tensor, weights: Tensor) -> Tensor:
        """Outputs (B, outputs) for inputs (B, features) in radians and flat weights."""
        if self._is_split:
            return self.of_registers(x, weights)
        cost = self.cost(x.shape[0], x.dtype, self.is_compiled(x, weights))
        if cost.method == "statevector" and cost.backend == "compiled" and cost.memory > memory.LARGE:
            memory.require(f"a batch of {x.shape[0]} samples of a circuit of {self.circuit.wires} wires", cost.memory)
        return self.family.evaluate(x, weights, cost)

    def of_registers(self, x: Tensor, weights: Tensor) -> Tensor:
        """The outputs, register by register."""
        sizes = [len(part.wires) for part, _ in self.parts]
        # All registers are fed at once: gradients of slices taken one by one would each be as large as x.
        wires = [wire for part, _ in self.parts for wire in part.wires]
        inputs = x[:, wires].split(sizes, 1)
        angles = weights.reshape(self.circuit.rows, -1, 3)[:, wires].split(sizes, 1)
        values = [own(x, w.flatten()) for (_, own), x, w in zip(self.parts, inputs, angles, strict=True)]
        places = np.argsort([output for part, _ in self.parts for output in part.outputs]).tolist()
        return torch.cat(values, 1)[:, places]


@lru_cache(maxsize=64)
def simulator_of(circuit: Circuit) -> Simulator:
    """The simulator of a circuit, kept: noise evaluates the same circuits again and again."""
    return Simulator(circuit)
