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
from qnerf.quantum.compiled.engine import Engine, work_bytes
from qnerf.quantum.cones import find_cones
from qnerf.quantum.cost_model import Cost, choose_engine
from qnerf.quantum.lightcone import LightCones
from qnerf.quantum.program import program
from qnerf.quantum.registers import Register, is_split, registers
from qnerf.quantum.statevector import Simulate

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
            memory.require(f"one sample of a circuit of {circuit.wires} wires", work_bytes(program(circuit), 1))
            _ = self._cones if method == "lightcone" else None

    @cached_property
    def _engine(self) -> Engine:
        return Engine(self.circuit)

    @cached_property
    def _cones(self) -> LightCones:
        return LightCones(find_cones(program(self.circuit)))

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
            if self._is_split:
                self._costs[key] = self._cost_of_registers(batch, dtype, compiled)
            else:
                self._costs[key] = choose_engine(self.circuit, self.method, batch, dtype, compiled)
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
        compiled = cost.backend == "compiled"
        plain = self._engine.plain
        simulate: Simulate = self._engine.simulate if compiled else plain.simulate
        if cost.method == "lightcone":
            return self._cones.evaluate(plain, simulate, x, weights, compiled)
        return plain.evaluate(x, weights, simulate)

    def of_registers(self, x: Tensor, weights: Tensor) -> Tensor:
        """The outputs, register by register."""
        # All registers are fed at once: gradients of slices taken one by one would each be as large as x.
        features = [feature for part, _ in self.parts for feature in part.features]
        places = [place for part, _ in self.parts for place in part.weights]
        inputs = x[:, features].split([len(part.features) for part, _ in self.parts], 1)
        angles = weights[places].split([len(part.weights) for part, _ in self.parts])
        values = [own(x, w) for (_, own), x, w in zip(self.parts, inputs, angles, strict=True)]
        order = np.argsort([output for part, _ in self.parts for output in part.outputs]).tolist()
        return torch.cat(values, 1)[:, order] + (x[:, :0].sum() + weights[:0].sum()).to(x)


@lru_cache(maxsize=64)
def simulator_of(circuit: Circuit) -> Simulator:
    """The simulator of a circuit, kept: noise evaluates the same circuits again and again."""
    return Simulator(circuit)
