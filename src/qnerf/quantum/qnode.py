"""`from_qnode`: a PennyLane QNode as a module that replaces `qml.qnn.TorchLayer`.

PennyLane makes the tape of each call, so that all it checks is checked and all that the function looks at is as it is
now. qnerf evaluates the tape; what it cannot evaluate runs on the QNode's own device.
"""

import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from copy import copy
from typing import Any

import numpy as np
import pennylane as qml
import torch
from torch import Tensor, nn

from qnerf.quantum.circuit import Circuit, Weights, feature
from qnerf.quantum.effects import warn
from qnerf.quantum.tapes import Measured, decomposed, described, execution_of, places_of

EXACT_DEVICES = {"default.qubit": "pennylane.", "qnerf.fast": "qnerf.", "lightning.qubit": "pennylane_lightning."}
"""Exact simulators and the modules of their classes. A subclass or a transformed device may compute something else."""

Shape = int | tuple[int, ...]


def from_qnode(
    qnode: Any,
    weight_shapes: Mapping[str, Shape],
    init_method: Callable[[Tensor], Tensor] | Mapping[str, Any] | None = None,
) -> nn.Module:
    """`qml.qnn.TorchLayer(qnode, weight_shapes)` with qnerf's engines: the same parameters, state_dict and outputs.

    >>> import pennylane as qml
    >>> @qml.qnode(qml.device("default.qubit", wires=2))
    ... def circuit(inputs, w):
    ...     qml.AngleEmbedding(inputs, wires=range(2))
    ...     qml.StronglyEntanglingLayers(w, wires=range(2))
    ...     return [qml.expval(qml.Z(0)), qml.expval(qml.X(0) @ qml.X(1))]
    >>> layer = from_qnode(circuit, {"w": (3, 2, 3)})
    >>> layer(torch.rand(5, 2)).shape, list(layer.state_dict()), layer.runs_on
    (torch.Size([5, 2]), ['w'], 'qnerf')

    `layer.runs_on` says what has evaluated the last call: qnerf, or the QNode's device and why. The layer warns once in
    the latter case. If the QNode is a circuit of polynomials (`layer.circuit`), its first call warns of what has no
    effect, see `qnerf.quantum.effects`. For that it calls the function once more.

    Args:
        qnode: a QNode whose function takes `inputs`, one sample or a batch (..., features), and the weights by name.
        weight_shapes: name -> shape of each weight.
        init_method: as TorchLayer takes it; by default every weight is uniform in [0, 2 pi].

    Raises:
        ValueError: no QNode; at a call, inputs that are no floating-point tensor. What PennyLane refuses, it refuses
            with its own errors.
    """
    if not isinstance(qnode, qml.QNode):
        raise ValueError(f"from_qnode expects a QNode, as qml.QNode(function, device) gives one, got {qnode!r}")
    return TorchLayer(_FastQnode(qnode), dict(weight_shapes), init_method)


class _FastQnode(qml.QNode):
    """The QNode, evaluated by qnerf where its device would give the same."""

    def __init__(self, qnode: Any) -> None:
        self.__dict__.update(vars(copy(qnode)))
        self.runs_on = "qnerf"
        self._has_warned = self.is_checked = False

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_tape": None, "_qfunc_output": None}  # the last call's: tensors that cannot be copied

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        reason = self._unlike_exact()
        if reason:
            return self._on_device(args, kwargs, reason)
        tape = self.construct(args, kwargs)
        returned, structure = qml.pytrees.flatten(self._qfunc_output, is_leaf=_is_measurement)
        try:
            execution = execution_of(tape, self.device.wires)
        except ValueError as error:
            return self._on_device(args, kwargs, str(error))
        if len(returned) != len(tape.measurements):
            return self._on_device(args, kwargs, f"measurements are returned in {type(returned[0]).__name__}")
        self.runs_on = "qnerf"
        return qml.pytrees.unflatten(execution.results(), structure)

    def _unlike_exact(self) -> str:
        """What of the QNode's settings an exact evaluation of its tape would leave out; "" for nothing."""
        module = EXACT_DEVICES.get(self.device.name)
        transformed = "Transform" in type(self.device).__name__
        if module is None or transformed or not type(self.device).__module__.startswith(module):
            return "another device than an exact simulator"
        if self.device.tracker.active:
            return "a Tracker counts its executions"
        if torch.compiler.is_exporting():
            return "torch.export sees operations of PyTorch only"
        if len(self.compile_pipeline):
            return f"transforms {self.compile_pipeline}"
        return "" if self.diff_method else "diff_method=None"

    def _on_device(self, args: Any, kwargs: Any, reason: str) -> Any:
        results = super().__call__(*args, **kwargs)
        self.runs_on = f"{self.device.name}: {reason}"
        if not self._has_warned:
            self._has_warned = True
            warnings.warn(f"from_qnode runs {self.func.__name__} on {self.runs_on}", stacklevel=2)
        return results


def _is_measurement(part: Any) -> bool:
    return isinstance(part, qml.measurements.MeasurementProcess)


class TorchLayer(qml.qnn.TorchLayer):
    """A TorchLayer whose circuit is evaluated by qnerf, made by `from_qnode`. PennyLane draws layers of this name."""

    _weights: dict[str, Any]

    @property
    def qnode_weights(self) -> dict[str, Any]:
        """The weights as they are now: a parameter may have been replaced, pruned or parametrised."""
        if not self._initialized:
            return self._weights
        own = self._parameters
        return {name: own[name] if name in own else getattr(self, name) for name in self._weights}

    @qnode_weights.setter
    def qnode_weights(self, weights: dict[str, Any]) -> None:
        self._weights = weights

    @torch.compiler.disable  # the engines are no operations of PyTorch, and following them takes minutes
    def forward(self, inputs: Tensor) -> Tensor:
        if not torch.is_tensor(inputs) or not inputs.is_floating_point():
            kind = f"a tensor of {inputs.dtype}" if torch.is_tensor(inputs) else type(inputs).__name__
            raise ValueError(f"from_qnode: the layer expects a floating-point tensor (..., features), got {kind}")
        if not inputs.numel() and inputs.ndim > 1:  # TorchLayer cannot reshape an empty batch
            one: Tensor = super().forward(inputs.new_zeros(1, inputs.shape[-1]))
            return one[:0].reshape(*inputs.shape[:-1], *one.shape[1:]) + inputs.sum()
        out: Tensor = super().forward(inputs)
        if self.qnode.runs_on == "qnerf" and not self.qnode.is_checked:
            self.qnode.is_checked = True
            with suppress(ValueError):  # no circuit of polynomials
                warn(self.circuit(inputs.shape[-1]))
        return out

    def circuit(self, features: int) -> Circuit:
        """The QNode as a circuit of polynomials of that many features and of the weights, for `QuantumLayer`.

        Raises:
            ValueError: an angle that is no polynomial, or a circuit whose form depends on values.
        """
        weights = [Weights(name, tuple(value.shape)) for name, value in self.qnode_weights.items()]
        arguments = {own.name: _entries(own) for own in weights}
        x, node = np.array([feature(index) for index in range(features)], dtype=object), copy(self.qnode)
        try:
            try:
                tape = node.construct((), arguments | {self.input_arg: x})
            except IndexError:  # the function expects a batch
                tape = node.construct((), arguments | {self.input_arg: x[None]})
            places = places_of(tape, node.device.wires)
            measured = Measured(tape.measurements, places)
            operations = described(decomposed(tape.operations), places)
        except Exception as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise ValueError(
                f"{self.qnode.func.__name__} is no circuit of polynomials of inputs and weights: {reason}"
            ) from error
        name, observables = self.qnode.func.__name__, measured.observables
        return Circuit(name, len(places), operations, observables, features, tuple(weights))


def _entries(weights: Weights) -> Any:
    """An array of the weights' expressions, in their shape; the expression itself for one number."""
    out = np.empty(weights.shape, dtype=object)
    for index in np.ndindex(*weights.shape):
        out[index] = weights[index]
    return out if weights.shape else out[()]
