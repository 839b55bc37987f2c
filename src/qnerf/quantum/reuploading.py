"""Data re-uploading circuits: the normal form, simulated as a state or expanded into polynomials of light cones."""

from dataclasses import replace
from functools import cached_property

import torch
from torch import Tensor

from qnerf.quantum import lightcone, statevector
from qnerf.quantum.circuit import Circuit
from qnerf.quantum.compiled import engine
from qnerf.quantum.cost_model import Cost, choose_engine, statevector_memory
from qnerf.quantum.normal_form import normal_form


class Reuploading:
    """A data re-uploading circuit; see `families.Family`."""

    def __init__(self, circuit: Circuit, method: str = "auto") -> None:
        self.circuit, self.method = circuit, method
        if method == "lightcone":
            _ = self._cone  # an error now, not at the first batch

    @cached_property
    def _cone(self) -> lightcone.LightConeEngine:
        return lightcone.LightConeEngine(self.circuit)

    @cached_property
    def _engine(self) -> engine.StatevectorEngine:
        return engine.StatevectorEngine(normal_form(self.circuit))

    def sample_bytes(self) -> int:
        return statevector_memory(normal_form(self.circuit), 1)

    def cost(self, batch: int, dtype: torch.dtype, compiled: bool) -> Cost:
        return choose_engine(self.circuit, self.method, batch, dtype, compiled)

    def evaluate(self, x: Tensor, weights: Tensor, cost: Cost) -> Tensor:
        compiled = cost.backend == "compiled"
        if cost.method == "lightcone":
            if compiled:
                return lightcone.evaluate(self._cone, x, weights)
            return lightcone.evaluate_reference(self.circuit, x, weights)
        if compiled:
            return engine.evaluate(self._engine, x, weights)
        return statevector.evaluate(normal_form(self.circuit), x, weights)

    def states(self, x: Tensor, weights: Tensor) -> Tensor:
        # A measurement of X on all wires keeps all gates in the normal form, and turns every wire alike.
        everything = tuple((wire, "X") for wire in range(self.circuit.wires))
        form = normal_form(replace(self.circuit, observables=(everything,)))
        return statevector.final_state(form, x, weights).T

    def bit_probabilities(self, x: Tensor, weights: Tensor) -> Tensor:
        return statevector.probabilities(normal_form(self.circuit), x, weights)
