"""The PennyLane device `qnerf.fast`: scripts that run on `default.qubit` run on it unchanged, and faster.

    dev = qml.device("qnerf.fast", wires=4)

It is a `default.qubit` whose exact expectation values, variances and probabilities are evaluated by qnerf. Everything
else, such as states and shots, is simulated as on `default.qubit`.
"""

import inspect
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pennylane as qml
from pennylane import math
from pennylane.devices import DefaultQubit, Device, ExecutionConfig
from pennylane.devices.modifiers import simulator_tracking, single_tape_support
from pennylane.tape import QuantumScript
from pennylane.transforms.core import CompilePipeline

from qnerf.config import memory
from qnerf.quantum.tapes import Execution, execution_of

simulate = inspect.unwrap(DefaultQubit.execute)  # without its Tracker: `FastDevice` has one
EXACT = {"backprop", None}
"""Gradient methods with which the results stay in the tape's interface; with others they are arrays of NumPy."""


class Decomposing(ExecutionConfig):
    """Of a device whose transforms see the tapes as on `default.qubit`, not the templates that qnerf takes whole."""


@simulator_tracking
@single_tape_support
class _Executing(Device):
    """`execute` of `FastDevice`: PennyLane's modifiers wrap it alone."""

    def execute(
        self, circuits: Sequence[QuantumScript], execution_config: ExecutionConfig | None = None
    ) -> tuple[Any, ...]:
        """The results of each tape."""
        config = execution_config or ExecutionConfig()
        fast = [_execution(tape, self.wires, config) for tape in circuits]
        others = [tape for tape, own in zip(circuits, fast, strict=True) if own is None]
        for tape in others:
            needed = 16 * 2 ** len(tape.wires) * (tape.batch_size or 1)
            if needed > memory.LARGE:
                memory.require("qnerf.fast: a state as of default.qubit", needed)
        rest = iter(simulate(self, others, config) if others else ())
        return tuple(next(rest) if own is None else _converted(own, config) for own in fast)


class FastDevice(_Executing, DefaultQubit):
    """`default.qubit` with qnerf's engines.

    They take tapes without shots whose parameters are numbers, arrays of NumPy or tensors of PyTorch. Derivatives are
    backprop through PyTorch, also where a script names `adjoint` or `device`. Tensors that are all float32 are computed
    with in float32, anything else in float64; results are float64, as on `default.qubit`.

    Args:
        wires: their number, or labels. None takes the wires of each tape.
        shots, seed, max_workers: as for `default.qubit`.
    """

    @property
    def name(self) -> str:
        """The name of the device."""
        return "qnerf.fast"

    def supports_derivatives(
        self, execution_config: ExecutionConfig | None = None, circuit: QuantumScript | None = None
    ) -> bool:
        """What `default.qubit` supports, and the method `device`."""
        return bool(super().supports_derivatives(_backprop(execution_config), circuit))

    def setup_execution_config(
        self, config: ExecutionConfig | None = None, circuit: QuantumScript | None = None
    ) -> ExecutionConfig:
        """The configuration of `default.qubit`, with backprop for the methods of other simulators.

        Of a transformed device or of a subclass it is a `Decomposing` one.
        """
        own = super().setup_execution_config(_backprop(config), circuit)
        return own if type(self) is FastDevice else Decomposing(**vars(own))

    def preprocess_transforms(self, execution_config: ExecutionConfig | None = None) -> CompilePipeline:
        """The transforms of `default.qubit`, for the tapes that it simulates."""
        config = execution_config or ExecutionConfig()
        if isinstance(config, Decomposing):
            return super().preprocess_transforms(config)
        pipeline = CompilePipeline()
        pipeline.add_transform(_unless_fast, self.wires, config, super().preprocess_transforms(config))
        return pipeline


def _backprop(config: ExecutionConfig | None) -> ExecutionConfig | None:
    """Scripts for other simulators name `adjoint` or `device`: exact derivatives, whichever way."""
    follows = {"device", "adjoint"} if config and config.interface == math.Interface.TORCH else {"device"}
    return replace(config, gradient_method="backprop") if config and config.gradient_method in follows else config


@qml.transform
def _unless_fast(tape: Any, wires: Any, config: ExecutionConfig, pipeline: CompilePipeline) -> Any:
    if _execution(tape, wires, config) is not None:
        return (tape,), lambda results: results[0]
    tapes, combined = pipeline((tape,))
    return tapes, lambda results: combined(results)[0]


def _execution(tape: QuantumScript, wires: Any, config: ExecutionConfig) -> Execution | None:
    if config.gradient_method == "adjoint":
        return None
    try:
        return execution_of(tape, wires)
    except ValueError:
        return None


def _converted(execution: Execution, config: ExecutionConfig) -> Any:
    """The results as tensors for PyTorch and tapes of tensors, else as arrays of the interface."""
    results: list[Any] = [value.double() for value in execution.results()]
    kept = config.gradient_method in EXACT
    if not (execution.numbers.is_torch or (kept and config.interface == math.Interface.TORCH)):
        results = [value.detach().numpy() for value in results]
        if kept and config.interface not in (math.Interface.NUMPY, math.Interface.AUTO):
            results = [math.asarray(value, like=config.interface.get_like()) for value in results]
    return results[0] if len(results) == 1 else tuple(results)
