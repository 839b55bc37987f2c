"""A QNode of PennyLane as a head: linear map, normalisation, circuit, linear map."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from inspect import Parameter, signature
from typing import Any

from torch import Tensor, nn

from qnerf.config.bounds import Factor
from qnerf.heads.base import HEADS, Head
from qnerf.heads.qiren import HybridLayer
from qnerf.quantum import QuantumLayer


class QnodeHead(Head):
    """(N, in_dim) -> (N, out_dim): linear, batch normalisation times `input_scale`, circuit times `gain`, linear.

    Args:
        in_dim, out_dim: features in and values out.
        described: a QNode of `inputs`, the shapes of its weights, and the number of its inputs.
        init: of the weights, see `QuantumLayer`.
        input_scale: factor on the normalised inputs, radians. Angles of several radians wrap around.
        gain: fixed factor on the measured values. These hardly vary at the start, so the last linear map would see
            almost a constant.

    Raises:
        ValueError: the QNode is no circuit of polynomials, see `from_qnode`.
    """

    quantum = True
    recipe = "qiren"

    @classmethod
    def label(cls, options: Mapping[str, Any]) -> str:
        """The registered name, then each option that is not the default: `mine-layers3`."""
        name = super().label(options)
        declared = HEADS.options(name)
        return "-".join([name, *(f"{key}{value}" for key, value in options.items() if value != declared[key].default)])

    def __init__(
        self,
        in_dim: int,
        out_dim: int,
        described: tuple[Any, Mapping[str, Any], int],
        *,
        init: str = "uniform",
        input_scale: Factor = 0.3,
        gain: Factor = 10.0,
    ) -> None:
        super().__init__()
        from qnerf.quantum import from_qnode  # PennyLane is imported only for who asks

        qnode, shapes, inputs = described
        named = replace(from_qnode(qnode, shapes).circuit(inputs), name=super().label({}))
        circuit = QuantumLayer(named, init=init)
        self.hybrid = HybridLayer(in_dim, inputs, circuit, input_scale=input_scale)
        self.gain = gain
        self.readout = nn.Linear(circuit.outputs, out_dim)

    def forward(self, features: Tensor) -> Tensor:
        """(N, in_dim) -> (N, out_dim)."""
        out: Tensor = self.readout(self.hybrid(features) * self.gain)
        return out


Described = Callable[..., tuple[Any, Mapping[str, Any], int]]


def qnode_head(function: Described) -> type[QnodeHead]:
    """Registers a `QnodeHead` under the function's name; use it as a decorator.

    function: its keyword-only parameters are options of the head, beside those of `QnodeHead`. It returns a QNode of
        `inputs` and weights, the shape of each weight by name, and the number of inputs.
    """

    def build(self: QnodeHead, in_dim: int, out_dim: int, **options: Any) -> None:
        own = {key: options.pop(key) for key in signature(function).parameters if key in options}
        QnodeHead.__init__(self, in_dim, out_dim, function(**own), **options)

    parameters = [*signature(function).parameters.values(), Parameter("options", Parameter.VAR_KEYWORD)]
    if any(one.kind is not Parameter.KEYWORD_ONLY for one in parameters[:-1]):
        raise ValueError(
            f"qnode_head: expected keyword-only parameters, such as {function.__name__}(*, wires: int = 6)"
        )
    build.__signature__ = signature(function).replace(parameters=parameters)  # type: ignore[attr-defined]
    build.__wrapped__ = function  # type: ignore[attr-defined]  # the module that annotations are looked up in
    build.__annotations__ = function.__annotations__
    members = {"__init__": build, "__doc__": function.__doc__, "__module__": function.__module__}
    head = type(function.__name__, (QnodeHead,), members)
    HEADS.register(function.__name__)(head)
    return head
