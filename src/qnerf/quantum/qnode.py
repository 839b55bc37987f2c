"""`from_qnode`: a PennyLane QNode as a module that replaces `qml.qnn.TorchLayer`.

The QNode's function runs once, on expressions in place of numbers. So it is known which angle is which weight, which
feature of the input, or which polynomial of them, and the function is not called again.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from threading import Lock
from typing import Any

import numpy as np
import pennylane as qml
import torch
from torch import Tensor, nn

from qnerf.quantum.circuit import Circuit, Weights, feature
from qnerf.quantum.expressions import Expression
from qnerf.quantum.simulator import Simulator
from qnerf.quantum.tapes import Measured, circuit_of, decomposed, described, places_of

Shape = int | tuple[int, ...]


def from_qnode(
    qnode: Any,
    weight_shapes: Mapping[str, Shape],
    init_method: Callable[[Tensor], Tensor] | Mapping[str, Any] | None = None,
) -> nn.Module:
    """A module with the parameters, the state_dict and the outputs of `qml.qnn.TorchLayer(qnode, weight_shapes)`.

    >>> import pennylane as qml
    >>> @qml.qnode(qml.device("default.qubit", wires=2))
    ... def circuit(inputs, w):
    ...     qml.AngleEmbedding(inputs, wires=range(2))
    ...     qml.StronglyEntanglingLayers(w, wires=range(2))
    ...     return [qml.expval(qml.Z(0)), qml.expval(qml.X(0) @ qml.X(1))]
    >>> layer = from_qnode(circuit, {"w": (3, 2, 3)})
    >>> layer(torch.rand(5, 2)).shape, list(layer.state_dict())
    (torch.Size([5, 2]), ['w'])

    Args:
        qnode: a QNode whose function takes `inputs`, of one sample or of a batch (..., features), and the weights by
            name. Its device and its diff_method do not matter.
        weight_shapes: name -> shape of each weight.
        init_method: as that of TorchLayer; by default every weight is uniform in [0, 2 pi].

    Raises:
        ValueError: transforms or shots on the QNode. At the first call: an angle that is no polynomial of weights and
            features, or an operation or measurement that cannot be run, by its name.
    """
    if len(qnode.compile_pipeline):
        raise ValueError(f"from_qnode expects a QNode without transforms, got {qnode.compile_pipeline}")
    if qnode.shots:
        raise ValueError(f"from_qnode is exact, got a QNode with shots={qnode.shots.total_shots}")
    return QnodeLayer(qnode, weight_shapes, init_method)


class QnodeLayer(qml.qnn.TorchLayer):
    """A TorchLayer whose circuit is evaluated by qnerf. `from_qnode` makes it."""

    def __init__(self, qnode: Any, weight_shapes: Mapping[str, Shape], init_method: Any = None) -> None:
        super().__init__(qnode, dict(weight_shapes), init_method)
        self.qnode = _Traced(qnode, {name: tuple(value.shape) for name, value in self.qnode_weights.items()})

    def circuit(self, features: int) -> Circuit:
        """The circuit for an input of that many features."""
        found: Circuit = self.qnode.built(features)[0].circuit
        return found


class _Traced:
    """What TorchLayer calls in place of the QNode."""

    def __init__(self, qnode: Any, shapes: dict[str, tuple[int, ...]]) -> None:
        self.func, self.shapes = qnode.func, shapes
        self.labels = qnode.device.wires
        self._built: dict[int, tuple[Simulator, Measured, type]] = {}

    def __call__(self, **arguments: Tensor) -> Any:
        weights = [arguments.pop(name).flatten() for name in self.shapes]
        (x,) = arguments.values()
        engine, measured, kind = self.built(x.shape[-1])
        dtype = x.dtype if x.dtype in (torch.float32, torch.float64) else torch.float32
        rows = x.to(dtype).reshape(-1, x.shape[-1])
        flat = torch.cat([rows.new_zeros(0), *(value.to(dtype) for value in weights)])
        results = measured.results(engine(rows, flat))
        if x.ndim == 1:
            results = [value[0] for value in results]
        return results[0] if kind not in (list, tuple) else kind(results)

    def built(self, features: int) -> tuple[Simulator, Measured, type]:
        """The engine for that many features, the measurements, and what the function returns: list, tuple or one."""
        if features not in self._built:
            circuit, measured, kind = self._trace(features)
            self._built[features] = Simulator(circuit), measured, kind
        return self._built[features]

    def _trace(self, features: int) -> tuple[Circuit, Measured, type]:
        weights = {name: Weights(name, shape) for name, shape in self.shapes.items()}
        traced: dict[str, Any] = {name: _entries(own) for name, own in weights.items()}
        (input_name,) = set(inspect.signature(self.func).parameters) - set(traced)
        x = np.array([feature(index) for index in range(features)], dtype=object)
        try:
            tape, kind = _run(self.func, traced | {input_name: x})
        except IndexError:  # the function expects a batch
            tape, kind = _run(self.func, traced | {input_name: x[None]})
        places = places_of(tape, self.labels)
        measured = Measured(tape.measurements, places)
        operations = described(decomposed(tape.operations), places, _read)
        return circuit_of(operations, measured, len(places), features, tuple(weights.values())), measured, kind


def _entries(weights: Weights) -> Any:
    """An array of the weights' expressions, in their shape; the expression itself for one number."""
    if not weights.shape:
        return weights[()]
    out = np.empty(weights.shape, dtype=object)
    for index in np.ndindex(*weights.shape):
        out[index] = weights[index]
    return out


def _run(function: Callable[..., Any], arguments: dict[str, Any]) -> tuple[Any, type]:
    """The tape of the function, and the type of what it returns."""
    returned: list[Any] = []
    try:
        with _unnormalised_amplitudes():
            tape = qml.tape.make_qscript(lambda: returned.append(function(**arguments)))()
    except IndexError:
        raise
    except Exception as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(f"from_qnode: {function.__name__} cannot be traced: {reason}") from error
    return tape, type(returned[0])


def _read(parameter: Any) -> Expression:
    if isinstance(parameter, Expression):
        return parameter
    values = np.asarray(parameter, dtype=object).reshape(-1)
    if len(values) != 1:
        raise ValueError(f"from_qnode: an angle expects one number for each sample, got {len(values)}")
    return Expression.of(values[0])


_preprocess = qml.StatePrep.__dict__["_preprocess"]
_patching = Lock()


@contextmanager
def _unnormalised_amplitudes() -> Iterator[None]:
    """Inside, AmplitudeEmbedding pads expressions and leaves their norm alone: `Amplitudes` are normalised later."""

    def preprocess(state: Any, wires: Any, pad_with: Any, normalize: bool, validate_norm: bool) -> Any:
        values = np.asarray(state)
        if values.dtype != object:
            return _preprocess.__func__(state, wires, pad_with, normalize, validate_norm)
        if pad_with is not None:
            missing = [(0, 0)] * (values.ndim - 1) + [(0, 2 ** len(wires) - values.shape[-1])]
            values = np.pad(values, missing, constant_values=pad_with)
        return values

    with _patching:
        qml.StatePrep._preprocess = staticmethod(preprocess)
        try:
            yield
        finally:
            qml.StatePrep._preprocess = _preprocess
