"""QuantumLayer: a batched circuit as an nn.Module."""

from collections.abc import Callable
from math import prod
from typing import Any, Literal

import torch
from torch import Tensor, nn

from qnerf.config.bounds import NonNegativeFactor, PositiveInt, Seed, checked
from qnerf.quantum import measurement, pennylane
from qnerf.quantum.circuit import ANSATZE, Circuit, Spectral, check_state, check_wires
from qnerf.quantum.cost_model import Cost
from qnerf.quantum.effects import warn
from qnerf.quantum.initial_angles import INITS
from qnerf.quantum.noise import Noise
from qnerf.quantum.simulator import Backend, Simulator

Method = Literal["auto", "lightcone", "statevector", "pennylane"]


class QuantumLayer(nn.Module):
    """The outputs of a trainable circuit: (..., features) angles in radians -> (..., outputs), by default in [-1, 1].

    A circuit of no features needs no input.

    >>> layer = QuantumLayer(8, 2)  # 8 wires, the input encoded twice
    >>> x = torch.randn(64, 3, 8, requires_grad=True)
    >>> y = layer(x)
    >>> y.shape, bool(y.abs().max() <= 1)
    (torch.Size([64, 3, 8]), True)
    >>> y.sum().backward()
    >>> layer.weights1.grad.shape, layer.weights2.grad.shape
    (torch.Size([2, 2, 8, 3]), torch.Size([2, 8, 3]))
    >>> QuantumLayer(8, 1).cost(6144).method, QuantumLayer(8, 2).cost(6144).method
    ('lightcone', 'statevector')

    Every circuit in `ANSATZE` has one output and one feature for each wire. Any other circuit is a `Circuit`:

    >>> from qnerf.quantum.circuit import Circuit, Gate, Weights, feature
    >>> w = Weights("w", (2,))
    >>> gates = Gate("RX", (0,), (feature(2),)), Gate("CRY", (0, 1), (w[0],)), Gate("RX", (1,), (w[1] * feature(0),))
    >>> layer = QuantumLayer(Circuit("mine", 2, operations=gates, observables=(((1, "X"),),), features=3, weights=(w,)))
    >>> layer(torch.randn(64, 3)).shape, layer.w.shape
    (torch.Size([64, 1]), torch.Size([2]))

    Args:
        wires: n, 1 to 1024; or a `Circuit`, which `spectral`, `ansatz` and `ansatz_options` then cannot change.
        spectral: S, encodings of the input (data re-uploadings), 1 to 64.
        method: auto takes the cheaper exact engine for the batch at hand (`cost` says which); lightcone evaluates
            trigonometric polynomials, statevector simulates, pennylane runs PennyLane's default.qubit.
        ansatz: a name in `qnerf.quantum.circuit.ANSATZE`; by default qiren.
        ansatz_options: keyword-only parameters of that ansatz.
        init: a name in `qnerf.quantum.initial_angles.INITS`. Angles are drawn from torch's global generator.
        backend: compiled is CPU code with its own backward pass; torch is plain PyTorch, for any device; auto takes
            compiled wherever it can run. Second and higher derivatives (`create_graph=True`), `torch.func` and forward
            derivatives go through plain PyTorch. `torch.compile` leaves the layer as it is and calls it.
        shots: measurements of each value; None for exact expectation values. Each output is drawn by itself.
        noise: a `Noise`, its fields, or a depolarizing probability. Training with shots and noise has the derivatives
            that `qnerf.quantum.measurement.Conditions` says with gradients=True.
        patterns: of Pauli errors, drawn anew in each call of a noisy circuit and shared by its samples.
        seed: of the shots and of the patterns; None draws from torch's global generator.

    Parameters: the circuit names them (`Circuit.parameters`). QIREN and its variants have `weights1` (S, L, n, 3) and
    `weights2` (L, n, 3), the angles phi, theta, omega in radians, as in published checkpoints. L is the number of
    sublayers of the ansatz, 2 by default.

    Precision is float32 or float64; an input of another precision is converted. For angles up to 1e36 rad, float32
    outputs are within 3e-6 of float64 (8 wires, S = 2; 1e-5 at S = 32) and never beyond 1. Inputs that are NaN or
    infinite give NaN.

    Warns of weights and features without effect and of constant outputs, see `qnerf.quantum.effects`.

    Raises:
        ValueError: a wrong last dimension, integer inputs, wires outside 1..1024, a state that memory cannot hold, an
            unknown name, or method=lightcone for a circuit without small light cones.
    """

    weights1: nn.Parameter
    weights2: nn.Parameter

    @checked
    def __init__(
        self,
        wires: int | Circuit,
        spectral: Spectral | None = None,
        *,
        method: Method = "auto",
        ansatz: str | None = None,
        init: str = "uniform",
        ansatz_options: dict[str, Any] | None = None,
        backend: Backend = "auto",
        shots: PositiveInt | None = None,
        noise: Noise | dict | NonNegativeFactor | None = None,
        patterns: PositiveInt = 4,
        seed: Seed | None = None,
    ) -> None:
        super().__init__()
        self.circuit = _described(wires, spectral, ansatz, ansatz_options)
        self.method, self.backend = method, backend
        self.conditions: measurement.Conditions | None = None
        own = measurement.Conditions(shots, Noise.of(noise), seed, patterns=patterns, gradients=True)
        if own.shots is not None or own.noisy:
            self.conditions = own
        self._simulator = None if method == "pennylane" else Simulator(self.circuit, method, backend)
        self._make_node()
        for name, values in _initial_weights(self.circuit, init).items():
            if hasattr(self, name):
                raise ValueError(f"weights cannot be called {name}, which is an attribute of a layer")
            self.register_parameter(name, nn.Parameter(values))
        warn(self.circuit)

    @property
    def wires(self) -> int:
        return self.circuit.wires

    def extra_repr(self) -> str:
        features = self.circuit.features
        return f"wires={self.wires}, features={features}, ansatz={self.circuit.name}, method={self.method}"

    def cost(self, batch: int = 6144) -> Cost:
        """The engine that `forward` takes for a batch, and what a step costs.

        Counts for the device and the precision of the parameters and for PyTorch's present number of threads.
        """
        if self._simulator is None:
            return Cost("pennylane", "torch", batch, 0, 0, 0, "asked for")
        first = next(self.parameters(), torch.empty(0))
        computed = torch.empty(0, dtype=_computed(first.dtype), device=first.device)
        return self._simulator.cost(batch, computed.dtype, self._simulator.is_compiled(computed))

    @property
    def outputs(self) -> int:
        return self.circuit.outputs

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_node": None}  # PennyLane's functions cannot be pickled

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._make_node()

    def _make_node(self) -> None:
        self._node: Callable[[Tensor, Tensor], Tensor] | None = None
        if self.method == "pennylane":
            check_state(self.wires, "device default.qubit")
            self._node = pennylane.make_node(self.circuit)

    def forward(self, x: Tensor | None = None) -> Tensor:
        if torch.jit.is_tracing() or torch.compiler.is_exporting():
            raise ValueError("torch.export and torch.jit.trace see no circuit; torch.compile takes a QuantumLayer")
        if torch.compiler.is_compiling():  # the engines are loops over NumPy arrays, which dynamo cannot follow
            out: Tensor = torch.compiler.disable(self._outputs)(x)
            return out
        return self._outputs(x)

    def _outputs(self, x: Tensor | None) -> Tensor:
        features = self.circuit.features
        if x is None and not features:
            x = next(self.parameters(), torch.empty(0)).new_empty(0)
        if not torch.is_tensor(x) or not x.is_floating_point():
            kind = f"a tensor of {x.dtype}" if torch.is_tensor(x) else type(x).__name__
            raise ValueError(
                f"QuantumLayer expects a floating-point tensor (..., {features}) of angles in radians, got {kind}"
            )
        if x.ndim == 0 or x.shape[-1] != features:
            raise ValueError(f"QuantumLayer expects shape (..., {features}), got {tuple(x.shape)}")
        parameters = [getattr(self, name) for name in self.circuit.parameters]
        dtype = _computed(torch.promote_types(x.dtype, parameters[-1].dtype) if parameters else x.dtype)
        angles = (x if x.ndim == 2 else x.reshape(prod(x.shape[:-1]), features)).resolve_neg().to(dtype)
        with torch.autocast(x.device.type, enabled=False):
            weights = torch.cat([angles.new_zeros(0), *(parameter.flatten().to(dtype) for parameter in parameters)])
            out = self.evaluate(angles, weights)
        return out if x.ndim == 2 else out.reshape(*x.shape[:-1], out.shape[-1])

    def evaluate(self, x: Tensor, weights: Tensor) -> Tensor:
        """Outputs (B, outputs) for inputs (B, features) in radians and the flat weights of all parameters."""
        conditions = self.conditions
        if conditions is None:
            return self._exact(x, weights)
        return measurement.measure(self.circuit, x, weights, self._exact, conditions)

    def _exact(self, x: Tensor, weights: Tensor) -> Tensor:
        if self._simulator is not None:
            return self._simulator(x, weights)
        assert self._node is not None
        return self._node(x, weights)


def _computed(dtype: torch.dtype) -> torch.dtype:
    """The precision of the engines for inputs or parameters of this one."""
    return dtype if dtype in (torch.float32, torch.float64) else torch.float32


def _described(
    wires: int | Circuit, spectral: int | None, ansatz: str | None, ansatz_options: dict[str, Any] | None
) -> Circuit:
    if isinstance(wires, Circuit):
        for name, value in {"spectral": spectral, "ansatz": ansatz, "ansatz_options": ansatz_options}.items():
            if value is not None:
                raise ValueError(f"{name} belongs to the circuit {wires.name}, which is given, got {name}={value!r}")
        return wires
    check_wires(wires)
    if spectral is None:
        raise ValueError("spectral is missing: how often the circuit takes in its input")
    return ANSATZE.build(ansatz or "qiren", wires, spectral, **(ansatz_options or {}))


def _initial_weights(circuit: Circuit, init: str) -> dict[str, Tensor]:
    """Starting values of the parameters, by name."""
    drawn = torch.empty(circuit.size)
    if not drawn.is_meta:  # else only the shapes count
        drawn = INITS.get(init)(circuit)
    values = {}
    for own, part in zip(circuit.weights, drawn.split([own.size for own in circuit.weights]), strict=True):
        part = part.reshape(own.shape)
        values[own.name] = part if own.initial is None else torch.full_like(part, own.initial)
    return values
