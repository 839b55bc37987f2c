"""The quantum head: hybrid layers of a linear map, a normalisation and a re-uploading circuit (QIREN)."""

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Annotated, Any, Literal

import torch
from annotated_types import Interval
from torch import Tensor, nn

from qnerf.config.bounds import Factor, NonNegativeFactor, PositiveInt
from qnerf.heads.base import HEADS, MIN_BATCH, Head
from qnerf.quantum import QuantumLayer, hardware_conditions
from qnerf.quantum.circuit import ANSATZE, Circuit, Spectral, Wires
from qnerf.quantum.layer import Method
from qnerf.quantum.noise import Field

Statistics = Literal["batch", "first"]


def check_samples(count: int) -> None:
    """ValueError if a circuit head gets too few samples in a training step."""
    if count < MIN_BATCH:
        raise ValueError(
            f"a circuit head normalises over the samples of a step: expected at least {MIN_BATCH}, got {count}; "
            "raise train.rays or the samples of a ray"
        )


class Normalisation(nn.BatchNorm1d):
    """Batch normalisation (N, wires) that stays accurate when the mean is far from 0.

    In float32 its error is at most 4e-6 of the largest value. PyTorch's own sums the rows one by one: at 6,144 rows its
    mean is off by up to 6e-5 |mean|, and its variance by the square of that. Centring the values first avoids this.

    Args:
        wires: columns.
        statistics: the mean and variance to use. `batch`: of each training step; evaluation uses their running means.
            `first`: of the first training batch, from then on and in evaluation too.
    """

    counted: Tensor | None = None
    """(N,) bool: the rows of which mean and variance are taken; None: all. Set by `model/chosen_rows.py`."""
    momentum: float
    running_mean: Tensor
    running_var: Tensor
    num_batches_tracked: Tensor

    def __init__(self, wires: int, *, statistics: Statistics = "batch") -> None:
        super().__init__(wires)
        self.statistics = statistics

    def forward(self, x: Tensor) -> Tensor:
        x = x.to(self.running_mean.dtype)  # under autocast, a linear map before this returns half precision
        if self.statistics == "first":
            return self._forward_first(x)
        if self.training and self.counted is not None:
            return self._forward_counted(x, self.counted)
        mean = x.detach().mean(0) if self.training else self.running_mean
        zero = torch.zeros_like(mean)  # in training it receives the running mean of the centred values
        normalised = nn.functional.batch_norm(
            x - mean, zero, self.running_var, self.weight, self.bias, self.training, self.momentum, self.eps
        )
        if self.training:
            self.running_mean.lerp_(mean, self.momentum)
            self.num_batches_tracked += 1
        return normalised

    @property
    def known(self) -> bool:
        """Whether the statistics are fixed already. A GPU is not asked: the step would wait for it."""
        return self.statistics == "first" and self.num_batches_tracked.is_cpu and bool(self.num_batches_tracked)

    def _forward_counted(self, x: Tensor, counted: Tensor) -> Tensor:
        """Training with the mean and the variance of the rows that count, without a wait for their number."""
        mean, centred, variance = _moments(x, counted)
        count = counted.sum()
        with torch.no_grad():
            self.running_mean.lerp_(mean, self.momentum)
            self.running_var.lerp_(variance * count / (count - 1), self.momentum)
            self.num_batches_tracked += 1
        return centred * (variance + self.eps).rsqrt() * self.weight + self.bias

    def _forward_first(self, x: Tensor) -> Tensor:
        if self.training and not self.known:
            mean, _, variance = _moments(x.detach(), self.counted)
            is_first = (self.num_batches_tracked == 0).to(x.dtype)
            self.running_mean.lerp_(mean, is_first)
            self.running_var.lerp_(variance, is_first)
            self.num_batches_tracked += 1
        scale = self.weight * (self.running_var + self.eps).rsqrt()
        return (x - self.running_mean) * scale + self.bias


def _moments(x: Tensor, counted: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """The mean (C,) of the counted rows of x (N, C), all rows less it, and the variance (C,) of the counted rows."""
    share = torch.ones_like(x[:, :1]) if counted is None else counted[:, None].to(x.dtype)
    share = share / share.sum()
    rough = (x.detach() * share).sum(0)
    rest = ((x - rough) * share).sum(0)  # what rounding has left
    centred = x - rough - rest
    return rough + rest, centred, (centred.square() * share).sum(0)


def without_drift(linear: nn.Linear, features: Tensor, normalised: bool) -> Tensor:
    """`linear(features)`, (N, wires); where they are `normalised` over the batch next, its bias does not train.

    Batch normalisation cancels the bias, so its gradient is pure rounding error. Adam would turn that into full steps:
    the bias would drift at random, and the running statistics that evaluation uses would lag behind it.
    """
    bias: Tensor = linear.bias
    if normalised:
        bias = bias.detach() + 0 * bias  # a gradient of exactly 0
    return nn.functional.linear(features, linear.weight, bias)


class HybridLayer(nn.Module):
    """Linear -> normalisation -> circuit: (N, in_dim) -> (N, outputs of the circuit), values in [-1, 1].

    Batch normalisation cancels the scale of the linear map, so `input_scale` multiplies the normalised values instead.
    They are the circuit's angles, in radians. Training on fewer than 2 rows raises ValueError: they have no variance.
    """

    def __init__(
        self,
        in_dim: int,
        wires: int,
        circuit: QuantumLayer,
        *,
        input_scale: float = 1.0,
        statistics: Statistics = "batch",
    ) -> None:
        super().__init__()
        self.linear = nn.Linear(in_dim, wires)
        self.norm = Normalisation(wires, statistics=statistics)
        self.circuit = circuit
        self.input_scale = input_scale

    def forward(self, features: Tensor) -> Tensor:
        if self.training and not self.norm.known:
            check_samples(len(features))
        angles = self.norm(without_drift(self.linear, features, self.training and self.norm.statistics == "batch"))
        if self.input_scale != 1.0:
            angles = angles * self.input_scale
        return self.circuit(angles)


def without_entanglers(circuit: Circuit) -> Circuit:
    """The circuit without its gates on several wires. ValueError if one of these holds a weight or a feature."""
    for gate in circuit.gates:
        if len(gate.wires) > 1 and gate.angles:
            raise ValueError(
                f"unitary=local leaves out entanglers; circuit {circuit.name} has {gate.name}, which is one with an "
                "angle: register a variant without it as an ansatz of its own"
            )
    return replace(circuit, operations=tuple(own for own in circuit.operations if len(own.wires) == 1))


@HEADS.register("qiren")
class QirenHead(Head):
    """A first hybrid layer, `layers` hidden ones, and a last linear map of the measured values: "xL+yS".

    One hybrid layer has 8 in + 8 + 16 + 48 (S + 1) trainable parameters at 8 qubits.

    Args:
        in_dim, out_dim: features in and values out.
        layers: hidden hybrid layers x (x + 1 circuits).
        spectral: data re-uploadings y of each circuit.
        qubits: wires of each circuit, 1 to 1,024; a state holds at most 20, see `QuantumLayer`.
        ansatz, method, init: see `QuantumLayer`.
        ansatz_options: name of an ansatz -> its options; only those of the chosen `ansatz` are used.
        gain: fixed factor on the measured values before the last linear map. Without it a head with uniform angles
            starts almost constant: its circuits vary by only 0.05 over their inputs.
        sum_layers: the last linear map sees the sum of all circuits' values instead of the last circuit's.
        input_scale: factor on the normalised inputs, radians.
        statistics: `batch` or `first`, see `Normalisation`.
        shots, noise, patterns: of each circuit, in training and in rendering, see `QuantumLayer`. Noise without any
            error and shots of None are exact.
        unitary: `circuit`: the circuit that is described; `local`: the same without entanglers; `random`: its angles
            are drawn at the start and kept. The last two are controls.
        center: start the last bias so that angles of 0 give 0. Measured values lie around a constant, which the gain
            multiplies too: without this, a density head starts as fog or empty, and a colour head saturated.
    """

    quantum = True
    recipe = "qiren"

    @classmethod
    def label(cls, options: Mapping[str, Any]) -> str:
        """`1L2S`: hidden layers and re-uploadings; `1L2S-local`: a control; `mine-1L2S`: an ansatz of the user's."""
        control = "" if options["unitary"] == "circuit" else f"-{options['unitary']}"
        ansatz = options["ansatz"]
        own = "" if ANSATZE.get(ansatz).__module__.startswith("qnerf.") else f"{ansatz}-"
        return f"{own}{options['layers']}L{options['spectral']}S{control}"

    @classmethod
    def without_effect(cls, options: Mapping[str, Any]) -> Collection[str]:
        noisy = any(options["noise"].values()) if options["noise"] else False
        return () if noisy else ("noise", "patterns")

    def __init__(
        self,
        in_dim: int,
        out_dim: int,
        *,
        layers: Annotated[int, Interval(ge=1, le=64)] = 1,
        spectral: Spectral = 2,
        qubits: Wires = 8,
        ansatz: str = "qiren",
        ansatz_options: dict[str, dict] | None = None,
        method: Method = "auto",
        init: str = "uniform",
        gain: Factor = 1.0,
        sum_layers: bool = False,
        input_scale: Factor = 1.0,
        statistics: Statistics = "batch",
        center: bool = False,
        unitary: Literal["circuit", "local", "random"] = "circuit",
        shots: PositiveInt | None = None,
        noise: dict[Field, NonNegativeFactor | None] | None = None,
        patterns: PositiveInt = 4,
    ) -> None:
        super().__init__()
        for name, options in (ansatz_options or {}).items():
            ANSATZE.check(name, options)
        self.gain = gain
        self.sum_layers = sum_layers
        self.hybrid = nn.ModuleList()
        own = (ansatz_options or {}).get(ansatz)
        described = self.described(ANSATZE.build(ansatz, qubits, spectral, **(own or {})))
        if unitary == "local":
            described = without_entanglers(described)
        for index in range(layers + 1):
            circuit = QuantumLayer(described, method=method, init=init, shots=shots, noise=noise, patterns=patterns)
            circuit.requires_grad_(unitary != "random")
            layer_in = in_dim if index == 0 else circuit.outputs
            self.hybrid.append(self.hybrid_layer(index, layer_in, qubits, circuit, input_scale, statistics))
        self.readout = nn.Linear(circuit.outputs, out_dim)
        if center and not self.readout.weight.is_meta:
            self.center()

    @torch.no_grad()
    def center(self) -> None:
        """Sets the last bias so that angles of 0, the mean of normalised inputs, give 0."""
        self.readout.bias.copy_(-nn.functional.linear(self.values_at_zero() * self.gain, self.readout.weight)[0])

    @torch.no_grad()
    def values_at_zero(self) -> Tensor:
        """(1, values): what the last linear map gets, before the gain, for angles of 0 in every circuit."""
        circuits = [module for module in self.modules() if isinstance(module, QuantumLayer)]
        with hardware_conditions.conditions(self):  # exact, also where the head has shots or noise
            values = [circuit(torch.zeros(1, circuit.wires)) for circuit in circuits]
        return torch.stack(values).sum(0) if self.sum_layers else values[-1]

    def described(self, circuit: Circuit) -> Circuit:
        """The circuit of every layer; a head that measures other values overrides this."""
        return circuit

    def hybrid_layer(
        self, index: int, in_dim: int, wires: int, circuit: QuantumLayer, input_scale: float, statistics: Statistics
    ) -> nn.Module:
        """The `index`-th layer; a head with other preprocessing overrides this."""
        return HybridLayer(in_dim, wires, circuit, input_scale=input_scale, statistics=statistics)

    def measured(self, features: Tensor) -> Tensor:
        """(N, in_dim) -> (N, values): of the last circuit, or the sum over all."""
        values = total = self.hybrid[0](features)
        for layer in self.hybrid[1:]:
            values = layer(values)
            total = total + values
        return total if self.sum_layers else values

    def forward(self, features: Tensor) -> Tensor:
        """(N, in_dim) -> (N, out_dim)."""
        return self.readout(self.measured(features) * self.gain)
