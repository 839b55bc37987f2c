"""A circuit ready to run: the cheapest exact engine for each batch, and wide circuits as registers."""

from typing import Literal

import numpy as np
import torch
from torch import Tensor

from qnerf.config import memory
from qnerf.kernels import is_transformed
from qnerf.kernels.jit import loop_threads
from qnerf.quantum import lightcone, pauli_cost, statevector
from qnerf.quantum.circuit import Circuit
from qnerf.quantum.compiled import engine as compiled
from qnerf.quantum.compiled import pauli_engine
from qnerf.quantum.cones import find_cones
from qnerf.quantum.cost_model import Cost, choose_engine, of_registers, statevector_memory
from qnerf.quantum.normal_form import normal_form
from qnerf.quantum.pauli_form import pauli_form
from qnerf.quantum.pauli_statevector import PauliCircuit
from qnerf.quantum.registers import Register, is_split, measured, registers

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
        self._cone: lightcone.LightConeEngine | None = None
        self._parts: list[tuple[Register, Simulator]] | None = None
        if method == "lightcone":
            find = lightcone.LightConeEngine if circuit.reuploading else find_cones
            self._cone = find(circuit)  # type: ignore[assignment]  # of other circuits an error
        self._is_split = is_split(circuit)
        if self._is_split:
            return
        what = f"one sample of a circuit of {circuit.wires} wires"
        if circuit.reuploading:
            memory.require(what, statevector_memory(normal_form(circuit), 1))
            self._engine = compiled.StatevectorEngine(normal_form(circuit))
        else:
            memory.require(what, pauli_cost.memory_bytes(pauli_form(circuit), 1))
            self._pauli = pauli_engine.PauliEngine(PauliCircuit(circuit))

    @property
    def parts(self) -> "list[tuple[Register, Simulator]]":
        """The registers of a wide circuit, each with its simulator."""
        if self._parts is None:
            found = registers(self.circuit)
            method = "auto" if self.method == "lightcone" else self.method
            own = {c: Simulator(c, method, self.backend) for c in dict.fromkeys(part.circuit for part in found)}
            self._parts = [(part, own[part.circuit]) for part in found]
        return self._parts

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
            if self.circuit.reuploading:
                self._costs[key] = choose_engine(self.circuit, self.method, batch, dtype, compiled)
            elif self._is_split:
                costs = [own.cost(batch, device, dtype, transformed) for _, own in self.parts]
                self._costs[key] = of_registers(costs, self.circuit, dtype)
            else:
                self._costs[key] = pauli_cost.cost(self._pauli.form, batch, dtype, compiled)
        return self._costs[key]

    def __call__(self, x: Tensor, weights: Tensor) -> Tensor:
        """Outputs (B, outputs) for inputs (B, features) in radians.

        The weights are stacked (rows, 3, n) for a re-uploading circuit, and flat for any other.
        """
        cost = self.cost(x.shape[0], x.device, x.dtype, is_transformed(x, weights))
        if cost.method == "lightcone":
            if cost.backend == "torch":
                return lightcone.evaluate_reference(self.circuit, x, weights)
            if self._cone is None:
                self._cone = lightcone.LightConeEngine(self.circuit)
            return lightcone.evaluate(self._cone, x, weights)
        if self._is_split:
            return self.of_registers(x, weights)
        if cost.backend == "torch":
            if self.circuit.reuploading:
                return statevector.evaluate(self._engine.form, x, weights)
            return self._pauli.plain.evaluate(x, weights)
        if cost.memory > memory.LARGE:
            memory.require(f"a batch of {x.shape[0]} samples of a circuit of {self.circuit.wires} wires", cost.memory)
        if self.circuit.reuploading:
            return compiled.evaluate(self._engine, x, weights)
        return self._pauli.evaluate(x, weights)

    def of_registers(self, x: Tensor, weights: Tensor) -> Tensor:
        """The outputs, register by register."""
        values: list[Tensor] = []
        order: list[int] = []
        for part, own in self.parts:
            values.append(own(x[:, list(part.features)], weights[..., list(part.weights)]))
            order += part.values
        places = np.argsort(order).tolist()
        return measured(self.circuit).outputs(torch.cat([x[:, :0], *values], 1)[:, places])
