"""QuantumLayer: a batched data re-uploading circuit as an nn.Module."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from qnerf.quantum import lightcone, measurement, pennylane, statevector
from qnerf.quantum.circuit import ANSATZE, Circuit, check_wires
from qnerf.quantum.compiled import engine as compiled
from qnerf.quantum.cost_model import Plan, make_plan
from qnerf.quantum.initial_angles import INITS
from qnerf.quantum.normal_form import compile_program

METHODS = ("auto", "lightcone", "statevector", "pennylane")
BACKENDS = ("auto", "compiled", "torch")


class QuantumLayer(nn.Module):
    """Expectation values of a parameterised circuit: (..., wires) angles in radians -> (..., wires) in [-1, 1].

    >>> layer = QuantumLayer(8, 2)
    >>> layer(torch.randn(1024, 48, 8)).shape
    torch.Size([1024, 48, 8])

    wires      n, 1..14
    spectral   S, encodings of the input (data re-uploadings), at least 1
    method     auto: the cheaper exact engine for the batch at hand (`plan` tells which); lightcone: trigonometric
               polynomials; statevector: simulation; pennylane: a PennyLane device
    ansatz     a name in `circuit.ANSATZE`; ansatz_options are its keyword-only parameters
    init       a name in `initial.INITS`; drawn from torch's global generator
    backend    compiled: CPU code with its own backward; torch: plain PyTorch, any device, differentiable twice; auto:
               compiled wherever it can run
    device, diff_method, shots, noise, seed    of method=pennylane, see `pennylane.make_node`

    Parameters: weights1 (S, 2, n, 3) and weights2 (2, n, 3), angles phi, theta, omega in radians, as in published QIREN
    checkpoints; 2 are the ansatz's sublayers. float32 and float64; an input of another precision is converted. At
    angles of up to 1e36 rad, float32 outputs are within 3e-6 of float64 (8 wires, S = 2; 1e-5 at S = 32), and never
    beyond 1. NaN or infinite inputs give NaN.
    ValueError for a wrong last dimension, integer inputs, wires outside 1..14, unknown names, or a lightcone that
    does not exist.
    """

    def __init__(
        self,
        wires: int,
        spectral: int,
        *,
        method: str = "auto",
        ansatz: str = "qiren",
        init: str = "uniform",
        ansatz_options: dict[str, Any] | None = None,
        backend: str = "auto",
        device: str = "default.qubit",
        diff_method: str = "backprop",
        shots: int | None = None,
        noise: pennylane.Noise | None = None,
        seed: int | None = None,
    ) -> None:
        super().__init__()
        check_wires(wires)
        if isinstance(spectral, bool) or not isinstance(spectral, int) or spectral < 1:
            raise ValueError(f"spectral must be an integer of at least 1, got {spectral!r}")
        for name, value, known in (("method", method, METHODS), ("backend", backend, BACKENDS)):
            if value not in known:
                raise ValueError(f"{name}: unknown name {value!r}; known: {', '.join(known)}")
        options = {"device": device, "diff_method": diff_method, "shots": shots, "noise": noise, "seed": seed}
        changed = [key for key, value in options.items() if value != _PENNYLANE_DEFAULTS[key]]
        if method != "pennylane" and changed:
            raise ValueError(f"{changed[0]} expects method=pennylane, got method={method}")
        self.circuit: Circuit = ANSATZE.build(ansatz, wires, spectral, **(ansatz_options or {}))
        self.program = compile_program(self.circuit)
        self.method, self.backend = method, backend
        self.conditions: measurement.Conditions | None = None
        self._node: Callable[[Tensor, Tensor], Tensor] | None = None
        if method == "pennylane":
            self._node = pennylane.make_node(
                self.circuit, device=device, diff_method=diff_method, shots=shots, noise=noise, seed=seed
            )
        self._engine = compiled.Engine(self.program)
        self._cone: lightcone.LightCone | None = None
        self._plans: dict[tuple[Any, ...], Plan] = {}
        if method == "lightcone":
            self._cone = lightcone.LightCone(self.circuit)
        first, second = self.circuit.shapes
        angles = INITS.get(init)(self.circuit)
        self.weights1 = nn.Parameter(angles[: -second[0]].reshape(first))
        self.weights2 = nn.Parameter(angles[-second[0] :].reshape(second))

    @property
    def wires(self) -> int:
        return self.circuit.wires

    @property
    def spectral(self) -> int:
        return self.circuit.spectral

    def extra_repr(self) -> str:
        return f"wires={self.wires}, spectral={self.spectral}, ansatz={self.circuit.name}, method={self.method}"

    def plan(self, batch: int = 6144) -> Plan:
        """The engine that `forward` takes for a batch of that size with the parameters' device and precision, and its
        cost."""
        return self._plan(batch, self.weights2.device, self.weights2.dtype)

    def _plan(self, batch: int, device: torch.device, dtype: torch.dtype) -> Plan:
        if self._node is not None:
            return Plan("pennylane", "torch", batch, 0, 0, 0, float("nan"), "asked for")
        compiled = self.backend != "torch" and device.type == "cpu"
        if self.backend == "compiled" and not compiled:
            raise ValueError(f"backend=compiled expects tensors on the CPU, got {device}; choose auto or torch")
        key = batch, device, dtype, torch.get_num_threads()
        if key not in self._plans:
            if len(self._plans) > 1000:
                self._plans.clear()
            self._plans[key] = make_plan(self.circuit, self.program, self.method, batch, dtype, compiled)
        return self._plans[key]

    def forward(self, x: Tensor) -> Tensor:
        if not torch.is_tensor(x) or not x.is_floating_point():
            kind = x.dtype if torch.is_tensor(x) else type(x).__name__
            raise ValueError(f"QuantumLayer expects a floating-point tensor of angles in radians, got {kind}")
        if x.ndim == 0 or x.shape[-1] != self.wires:
            raise ValueError(f"QuantumLayer expects shape (..., {self.wires}), got {tuple(x.shape)}")
        dtype = torch.promote_types(x.dtype, self.weights2.dtype)
        dtype = dtype if dtype in (torch.float32, torch.float64) else torch.float32
        with torch.autocast(x.device.type, enabled=False):
            flat = x.reshape(-1, self.wires).to(dtype)
            out = self._outputs(flat, dtype)
        return out.reshape(*x.shape[:-1], out.shape[-1])

    def _outputs(self, x: Tensor, dtype: torch.dtype) -> Tensor:
        weights = statevector.stacked(self.weights1, self.weights2).to(dtype)
        given = self.conditions
        if given is not None:
            exact = self._exact(x, weights) if given.needs_exact else None
            return measurement.measure(self.circuit, x, weights, exact, given)
        return self._exact(x, weights)

    def _exact(self, x: Tensor, weights: Tensor) -> Tensor:
        if self._node is not None:
            return self._node(x, weights.transpose(1, 2))
        plan = self._plan(x.shape[0], x.device, x.dtype)
        if plan.method == "lightcone":
            if plan.backend == "torch":
                return lightcone.evaluate_reference(self.circuit, x, weights)
            if self._cone is None:
                self._cone = lightcone.LightCone(self.circuit)
            return lightcone.evaluate(self._cone, x, weights)
        if plan.backend == "torch":
            return statevector.evaluate(self.program, x, weights)
        return compiled.evaluate(self._engine, x, weights)


_PENNYLANE_DEFAULTS: dict[str, Any] = {
    "device": "default.qubit",
    "diff_method": "backprop",
    "shots": None,
    "noise": None,
    "seed": None,
}
