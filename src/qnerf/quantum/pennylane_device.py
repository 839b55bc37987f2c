"""The PennyLane device `qnerf.fast`: scripts that run on `default.qubit` run on it unchanged, and faster.

    dev = qml.device("qnerf.fast", wires=4)

It executes tapes, broadcast ones too, and differentiates them by backprop through PyTorch. The other interfaces
differentiate by the parameter-shift rule.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from pennylane import math
from pennylane.devices import Device, ExecutionConfig
from pennylane.devices.modifiers import simulator_tracking, single_tape_support
from pennylane.devices.preprocess import no_sampling, validate_device_wires, validate_measurements
from pennylane.exceptions import DeviceError
from pennylane.gradients import param_shift
from pennylane.tape import QuantumScript
from pennylane.transforms.core import CompilePipeline
from torch import Tensor

from qnerf.quantum.circuit import Operation, Weights, feature, weight
from qnerf.quantum.expressions import Expression
from qnerf.quantum.simulator import Simulator
from qnerf.quantum.tapes import Measured, circuit_of, decomposed, described, is_measurement, places_of

OWN_METHODS = {"adjoint", "device"}  # scripts for other simulators name these: exact derivatives, whichever way


@simulator_tracking
@single_tape_support
class FastDevice(Device):
    """Exact expectation values, variances and probabilities of circuits of qubits.

    Parameters of a tape that are float32 tensors are computed with in float32, all others in float64; results are
    float64, as those of `default.qubit`.

    Args:
        wires: their number, or labels. None takes those of each tape.
        shots: None. Finite shots are refused.

    Raises:
        DeviceError: an operation or a measurement that it cannot run, by its name; more wires than 20 or than fit
            into memory.
    """

    name = "qnerf.fast"

    def __init__(self, wires: Any = None, shots: Any = None) -> None:
        if shots is not None:
            raise DeviceError(f"qnerf.fast is exact, got shots={shots}; default.qubit takes shots")
        super().__init__(wires=wires, shots=shots)

    def supports_derivatives(
        self, execution_config: ExecutionConfig | None = None, circuit: QuantumScript | None = None
    ) -> bool:
        """Backprop through PyTorch, which stands for a simulator's own methods as well."""
        if execution_config is None:
            return True
        method = execution_config.gradient_method
        return method in OWN_METHODS or (method in {"backprop", "best"} and _follows(execution_config.interface))

    def setup_execution_config(
        self, config: ExecutionConfig | None = None, circuit: QuantumScript | None = None
    ) -> ExecutionConfig:
        """Backprop where no other method is named and the interface is PyTorch."""
        config = config or ExecutionConfig()
        method: Any = config.gradient_method
        if method == "best" or method in OWN_METHODS:
            method = "backprop" if _follows(config.interface) else param_shift
        backprop = method == "backprop"
        return replace(config, gradient_method=method, use_device_gradient=backprop, convert_to_numpy=not backprop)

    def preprocess_transforms(self, execution_config: ExecutionConfig | None = None) -> CompilePipeline:
        """Checks of wires and measurements. `execute` decomposes the operations (`tapes.decomposed`)."""
        program = CompilePipeline()
        program.add_transform(no_sampling, name=self.name)
        program.add_transform(validate_device_wires, self.wires, name=self.name)
        program.add_transform(validate_measurements, analytic_measurements=is_measurement, name=self.name)
        return program

    def execute(
        self, circuits: Sequence[QuantumScript], execution_config: ExecutionConfig | None = None
    ) -> tuple[Any, ...]:
        """The results of each tape."""
        try:
            is_torch = execution_config is not None and execution_config.interface == math.Interface.TORCH
            return tuple(self._run(tape, is_torch) for tape in circuits)
        except ValueError as error:
            raise DeviceError(f"qnerf.fast: {error}") from error

    def _run(self, tape: QuantumScript, is_torch: bool) -> Any:
        places = places_of(tape, self.wires)
        slots = _Slots()
        operations = described(decomposed(tape.operations), places, slots)
        measured = Measured(tape.measurements, places)
        engine = _engine(operations, _Key(measured), max(len(places), 1), len(slots.features), len(slots.weights))
        x, weights = slots.tensors(tape.batch_size or 1)
        results = [value.double() for value in measured.results(engine(x, weights))]
        if tape.batch_size is None:
            results = [value[0] for value in results]
        if not (is_torch or slots.is_torch):
            return _one_or_all([value.detach().numpy() for value in results])
        return _one_or_all(results)


def _follows(interface: Any) -> bool:
    """Whether derivatives can go through PyTorch."""
    return interface not in (math.Interface.AUTOGRAD, math.Interface.JAX, math.Interface.JAX_JIT, math.Interface.TF)


def _one_or_all(results: list[Any]) -> Any:
    return results[0] if len(results) == 1 else tuple(results)


class _Slots:
    """Takes the parameters of a tape: one number is a weight of the circuit, one for each sample is a feature."""

    def __init__(self) -> None:
        self.weights: list[Any] = []
        self.features: list[Any] = []
        self.is_torch = False

    def __call__(self, parameter: Any) -> Expression:
        self.is_torch = self.is_torch or torch.is_tensor(parameter)
        kind, make = (self.features, feature) if math.ndim(parameter) else (self.weights, _weight)
        kind.append(parameter)
        return make(len(kind) - 1)

    def tensors(self, batch: int) -> tuple[Tensor, Tensor]:
        """The features (B, features) and the flat weights."""
        given = [p for p in (*self.weights, *self.features) if torch.is_tensor(p)]
        single = bool(given) and all(p.dtype == torch.float32 for p in given)
        dtype = torch.float32 if single else torch.float64
        device = given[0].device if given else torch.device("cpu")

        def joined(values: list[Any], dim: int, empty: tuple[int, ...]) -> Tensor:
            if not values:
                return torch.zeros(empty, dtype=dtype, device=device)
            if any(map(torch.is_tensor, values)):
                tensors = [v if torch.is_tensor(v) else torch.as_tensor(v, dtype=torch.float64) for v in values]
                return torch.stack([tensor.to(device, dtype) for tensor in tensors], dim)
            together = np.stack([np.asarray(value, dtype=np.float64) for value in values], axis=dim)
            return torch.from_numpy(together).to(dtype)

        return joined(self.features, -1, (batch, 0)), joined(self.weights, 0, (0,))


@lru_cache(maxsize=4096)
def _weight(index: int) -> Expression:
    return weight("parameters", index)


class _Key:
    """What tells two `Measured` apart in a cache."""

    def __init__(self, measured: Measured) -> None:
        self.measured, self.key = measured, measured.key

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self.key == other.key


@lru_cache(maxsize=256)
def _engine(operations: tuple[Operation, ...], key: _Key, wires: int, features: int, weights: int) -> Simulator:
    own = (Weights("parameters", (weights,)),) if weights else ()
    return Simulator(circuit_of(operations, key.measured, wires, features, own))
