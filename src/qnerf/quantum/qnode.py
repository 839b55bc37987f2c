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
from qnerf.quantum.tapes import KNOWN_MEASUREMENTS, Measured, circuit_of, decomposed, described, places_of

ADVICE = (
    "; an angle is a polynomial of inputs and weights: take other functions of them before the layer, "
    'or run the QNode on qml.device("qnerf.fast")'
)

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
            name. Other parameters keep their defaults. Its device and its diff_method do not matter.
        weight_shapes: name -> shape of each weight.
        init_method: as that of TorchLayer; by default every weight is uniform in [0, 2 pi].

    Raises:
        ValueError: no QNode, transforms or shots on it, a weight without a shape. At the first call: an angle that is
            no polynomial of weights and features, or an operation or measurement that cannot be run, by its name.
    """
    if not isinstance(qnode, qml.QNode):
        raise ValueError(f"from_qnode expects a QNode, as qml.QNode(function, device) gives one, got {qnode!r}")
    _check_names(qnode, weight_shapes)
    if len(qnode.compile_pipeline):
        raise ValueError(f"from_qnode expects a QNode without transforms, got {qnode.compile_pipeline}")
    if qnode.shots:
        raise ValueError(f"from_qnode is exact, got a QNode with shots={qnode.shots.total_shots}")
    return QnodeLayer(qnode, weight_shapes, init_method)


def _check_names(qnode: Any, weight_shapes: Mapping[str, Shape]) -> None:
    """ValueError unless the function takes inputs, and every other parameter has a shape or a default."""
    name, own = QnodeLayer._input_arg, _parameters(qnode)
    if name not in own:
        raise ValueError(
            f"from_qnode expects a function of `{name}` and of weights, got {', '.join(own) or 'no parameters'}; "
            'a circuit without data runs on qml.device("qnerf.fast")'
        )
    known = [key for key in own if key != name]
    taken = [key for key in weight_shapes if key == "qnode" or hasattr(QnodeLayer, key) or hasattr(nn.Module(), key)]
    if taken:
        raise ValueError(f"from_qnode: a weight cannot be called {', '.join(taken)}, as something of its module is")
    missing = [key for key in known if key not in weight_shapes and own[key].default is inspect.Parameter.empty]
    unknown = [] if _takes_any(qnode) else [key for key in weight_shapes if key not in known]
    if missing or unknown:
        which = f"misses {', '.join(missing)}" if missing else f"got {', '.join(unknown)}"
        raise ValueError(f"from_qnode expects weight_shapes for the parameters {', '.join(known) or 'none'}, {which}")


def _parameters(qnode: Any) -> dict[str, inspect.Parameter]:
    """The named parameters of the function."""
    parameters = inspect.signature(qnode.func).parameters
    return {name: own for name, own in parameters.items() if own.kind is not inspect.Parameter.VAR_KEYWORD}


def _takes_any(qnode: Any) -> bool:
    return len(_parameters(qnode)) < len(inspect.signature(qnode.func).parameters)


class QnodeLayer(qml.qnn.TorchLayer):
    """A TorchLayer whose circuit is evaluated by qnerf. `from_qnode` makes it."""

    _weights: dict[str, Any]

    def __init__(self, qnode: Any, weight_shapes: Mapping[str, Shape], init_method: Any = None) -> None:
        super().__init__(qnode, dict(weight_shapes), init_method)
        self.qnode = _Traced(qnode, {name: tuple(value.shape) for name, value in self.qnode_weights.items()})
        self._weights = dict.fromkeys(self._weights)

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

    def _signature_validation(self, qnode: Any, weight_shapes: dict[str, Any]) -> None:
        """`from_qnode` has checked the names, and lets parameters keep their defaults."""

    @torch.compiler.disable  # the engines are no operations of PyTorch, and following them takes minutes
    def forward(self, inputs: Tensor) -> Tensor:
        if not torch.is_tensor(inputs) or not inputs.is_floating_point():
            kind = f"a tensor of {inputs.dtype}" if torch.is_tensor(inputs) else type(inputs).__name__
            raise ValueError(f"from_qnode: the layer expects a floating-point tensor (..., features), got {kind}")
        if not inputs.numel() and inputs.ndim > 1:  # TorchLayer cannot reshape an empty batch
            one: Tensor = super().forward(inputs.new_zeros(1, inputs.shape[-1]))
            return one[:0].reshape(*inputs.shape[:-1], *one.shape[1:]) + inputs.sum()
        out: Tensor = super().forward(inputs)
        return out

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
        input_name = QnodeLayer._input_arg
        x = np.array([feature(index) for index in range(features)], dtype=object)
        try:
            tape, kind = _run(self.func, traced | {input_name: x})
        except IndexError:  # the function expects a batch
            tape, kind = _run(self.func, traced | {input_name: x[None]})
        if not tape.measurements:
            raise ValueError(f"from_qnode: {self.func.__name__} returns no measurement; known: {KNOWN_MEASUREMENTS}")
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
        said = isinstance(error, ValueError)  # of PennyLane or of an expression, about a shape or an operand
        raise ValueError(
            f"from_qnode: {function.__name__} cannot be traced: {reason}{'' if said else ADVICE}"
        ) from error
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
        count = len(qml.wires.Wires(wires))
        if values.shape[-1] > 2**count:
            raise ValueError(f"a state of {count} wires has {2**count} amplitudes, got {values.shape[-1]}")
        if pad_with is not None:
            missing = [(0, 0)] * (values.ndim - 1) + [(0, 2**count - values.shape[-1])]
            values = np.pad(values, missing, constant_values=pad_with)
        return values

    with _patching:
        qml.StatePrep._preprocess = staticmethod(preprocess)
        try:
            yield
        finally:
            qml.StatePrep._preprocess = _preprocess
