"""A circuit ready to run: the cheapest exact engine for each batch, and wide circuits as registers."""

from functools import cached_property
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from qnerf.config import memory
from qnerf.kernels import is_transformed
from qnerf.kernels.jit import loop_threads
from qnerf.quantum.circuit import Circuit
from qnerf.quantum.cost_model import Cost
from qnerf.quantum.families import family_of
from qnerf.quantum.registers import Register, is_split, measured

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
        self.family = family_of(circuit, method)
        self._costs: dict[tuple[object, ...], Cost] = {}
        self._is_split = is_split(circuit)
        if not self._is_split:
            memory.require(f"one sample of a circuit of {circuit.wires} wires", self.family.sample_bytes())

    @cached_property
    def parts(self) -> "list[tuple[Register, Simulator]]":
        """The registers of a wide circuit, each with its simulator."""
        found = self.family.registers()
        method = "auto" if self.method == "lightcone" else self.method
        own = {c: Simulator(c, method, self.backend) for c in dict.fromkeys(part.circuit for part in found)}
        return [(part, own[part.circuit]) for part in found]

    def cost(self, batch: int, device: torch.device, dtype: torch.dtype, transformed: bool = False) -> Cost:
        """The engine for a batch, and what a step costs. transformed: inside `torch.func`."""
        on_cpu = device.type == "cpu"
        if self.backend == "compiled" and not on_cpu:
            raise ValueError(f"backend=compiled expects tensors on the CPU, got {device}; choose auto or torch")
        key = batch, device, dtype, loop_threads(), transformed
        if key not in self._costs:
            if len(self._costs) > 1000:
                self._costs.clear()
            compiled = on_cpu and self.backend != "torch" and not transformed
            self._costs[key] = self.family.cost(batch, dtype, compiled)
        return self._costs[key]

    def __call__(self, x: Tensor, weights: Tensor) -> Tensor:
        """Outputs (B, outputs) for inputs (B, features) in radians and flat weights."""
        cost = self.cost(x.shape[0], x.device, x.dtype, is_transformed(x, weights))
        if cost.method == "statevector" and self._is_split:
            return self.of_registers(x, weights)
        if cost.method == "statevector" and cost.backend == "compiled" and cost.memory > memory.LARGE:
            memory.require(f"a batch of {x.shape[0]} samples of a circuit of {self.circuit.wires} wires", cost.memory)
        return self.family.evaluate(x, weights, cost)

    def of_registers(self, x: Tensor, weights: Tensor) -> Tensor:
        """The outputs, register by register."""
        values: list[Tensor] = []
        order: list[int] = []
        for part, own in self.parts:
            values.append(own(x[:, list(part.features)], weights[..., list(part.weights)]))
            order += part.values
        places = np.argsort(order).tolist()
        return measured(self.circuit).outputs(torch.cat([x[:, :0], *values], 1)[:, places])
