"""Amplitude encoding: features become the amplitudes of a state, a unitary acts on it, Z is measured."""

from collections.abc import Collection, Mapping, Sequence
from itertools import combinations
from typing import Annotated, Any, Literal

import torch
from annotated_types import Interval, MaxLen, MinLen
from torch import Tensor, nn

from qnerf.config.bounds import Factor, PositiveFactor
from qnerf.heads.base import HEADS, Head
from qnerf.heads.registers import AmplitudeRegister, BlochRegister, Encoding, product
from qnerf.heads.unitaries import Kind, Unitaries
from qnerf.kernels import is_transformed
from qnerf.kernels.derivatives import is_differentiated
from qnerf.quantum.basis import bit, z_signs

MAX_QUBITS = 10  # that one circuit acts on: matrices have 4^n entries
Qubits = Annotated[int, Interval(ge=1, le=MAX_QUBITS)]
Values = Literal["Z", "ZZ"]
DIRECTION = 3  # features of a colour head, the first ones, that are the view direction


class NormalisedForms(torch.autograd.Function):
    """(N, k) and (m, k) -> (N, m): sum_k weights_mk u_nk^2 / sum_k u_nk^2.

    The same as autograd's derivatives of `normalised_forms`, with fewer passes over u.
    """

    @staticmethod
    def forward(ctx: Any, u: Tensor, weights: Tensor) -> Tensor:
        parts = normalised_forms(u, weights)
        ctx.save_for_backward(u, weights, *parts)
        return parts[-1]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        u, weights, squares, total, out = ctx.saved_tensors
        if is_differentiated(gradient):  # second derivatives need them as functions of u and weights
            squares, total, out = normalised_forms(u, weights)
        share = gradient / total
        of_u = torch.addmm((share * out).sum(1, keepdim=True), share, weights, beta=-2, alpha=2).mul_(u)
        return of_u, share.T @ squares


def normalised_forms(u: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """u^2, its sums (N, 1), and the result of `NormalisedForms`."""
    squares = u * u
    total = squares.sum(1, keepdim=True)
    return squares, total, squares @ weights.T / total


class System(nn.Module):
    """Registers that one circuit acts on, and the probabilities of what is measured.

    The state is the tensor product of the registers' amplitudes. Then come `uploads` encodings, RZ by
    frequency x (V x + c) on every wire, with a unitary before, between and after them.
    """

    frequencies: Tensor
    measured: Tensor
    signs: Tensor

    def __init__(
        self,
        registers: list[nn.Module],
        wires: int,
        in_dim: int,
        unitaries: Unitaries,
        frequencies: str,
        values: Values,
    ) -> None:
        super().__init__()
        self.wires = wires
        self.register_buffer("measured", eigenvalues(wires, values), persistent=False)
        self.registers = nn.ModuleList(registers)
        self.unitaries = unitaries
        self.uploads = unitaries.count - 1
        if self.uploads:
            self.register_buffer("signs", eigenvalues(wires, "Z"), persistent=False)
            self.upload = nn.Linear(in_dim, wires)
            powers = 3.0 ** torch.arange(self.uploads)[:, None].expand(-1, wires)
            if frequencies == "ternary":
                self.frequencies = nn.Parameter(powers.clone())
            else:
                self.register_buffer("frequencies", torch.ones_like(powers))

    @property
    def folds(self) -> bool:
        """Whether the unitary can be multiplied into the linear map that makes the amplitudes: |U v| = |v|."""
        first = self.registers[0] if len(self.registers) == 1 else None
        return isinstance(first, AmplitudeRegister) and first.encoding == "normalised" and not self.uploads

    def forward(self, parts: list[Tensor], features: Tensor, weights: Tensor) -> Tensor:
        """The measured values times weights (out, values): (N, out).

        parts: the features of each register, (N, ...). features: the input of the encodings.
        """
        weights = weights @ self.measured  # (out, 2^n), on the probabilities of the basis states
        return self._folded(parts[0], weights) if self.folds else self._state(parts, features, weights)

    def _folded(self, features: Tensor, weights: Tensor) -> Tensor:
        """p_k = u_k^2 / sum(u^2) with u = U W x + U b: what an MLP with squares and a division costs."""
        register = self.registers[0]
        assert isinstance(register, AmplitudeRegister)
        weight: Tensor = register.linear.weight
        bias: Tensor = register.linear.bias
        (unitary,) = self.unitaries()
        if unitary is not None:
            dtype = torch.promote_types(unitary.dtype, weight.dtype)
            weight, bias = unitary.to(dtype) @ weight.to(dtype), unitary.to(dtype) @ bias.to(dtype)
        if weight.is_complex():
            weight, bias = torch.cat([weight.real, weight.imag]), torch.cat([bias.real, bias.imag])
            weights = weights.repeat(1, 2)
        u = nn.functional.linear(register.inputs(features), weight, bias)
        if is_transformed(u, weights):
            return normalised_forms(u, weights)[-1]
        out: Tensor = NormalisedForms.apply(u, weights)
        return out

    def _state(self, parts: list[Tensor], features: Tensor, weights: Tensor) -> Tensor:
        state = self.prepared(parts, features)
        angles = self.upload(features) if self.uploads else None
        for index, unitary in enumerate(self.unitaries()):
            if unitary is not None:
                dtype = torch.promote_types(unitary.dtype, state.dtype)
                state = state.to(dtype) @ unitary.to(dtype).T
            if angles is not None and index < self.uploads:
                half = (angles * self.frequencies[index]) @ self.signs / 2
                state = state * torch.complex(half.cos(), -half.sin())
        return probabilities(state) @ weights.T

    def prepared(self, parts: list[Tensor], features: Tensor) -> Tensor:
        """The state (N, 2^n) before the first unitary; without registers |0...0> (1, 2^n), the same for all samples."""
        if self.registers:
            return product([register(part) for register, part in zip(self.registers, parts, strict=True)])
        return nn.functional.pad(torch.ones_like(features[:1, :1]), (0, 2**self.wires - 1))


def probabilities(state: Tensor) -> Tensor:
    return state.real.square() + state.imag.square() if state.is_complex() else state.square()


def eigenvalues(wires: int, values: Values) -> Tensor:
    """(values, 2^n): what each measured value is on each basis state."""
    masks = [bit(wire, wires) for wire in range(wires)]
    if values == "ZZ":
        masks += [a | b for a, b in combinations(masks, 2)]
    return torch.from_numpy(z_signs(masks, wires)).to(torch.get_default_dtype())


def _made(sizes: Sequence[int], registers: Sequence[int], *, points: bool, **options: Any) -> list[nn.Module]:
    """Registers of so many features and qubits each. points: the last one is a `BlochRegister`."""
    made: list[nn.Module] = []
    for size, qubits in zip(sizes, registers, strict=True):
        is_last = len(made) == len(registers) - 1
        made.append(BlochRegister(size, qubits) if points and is_last else AmplitudeRegister(size, qubits, **options))
    return made


@HEADS.register("amplitude")
class AmplitudeHead(Head):
    """Amplitude encoding, a unitary, measured values, a last linear map (docs/heads.md).

        psi = U a(x),   a = (W x + b) / |W x + b|,   values <Z_i>, <Z_i Z_j>,   out = gain R values + c

    R starts by He's rule, and c so that x = 0 gives 0. Where the state is one normalised register, U (W x + b) =
    (U W) x + U b: the unitary is multiplied into W once a step and costs nothing per sample. For the same reason W can
    take the place of any U. The defaults are the best form that we found; heads after publications are choices of
    conf/head.

    Args:
        registers: qubits of each register; the state is their tensor product. One circuit has at most 10 qubits.
            Registers of one qubit are a product state of angles, which no longer absorbs a unitary.
        encoding: of each register, see `AmplitudeRegister`; none: the wires start in |0...0>.
        hidden: ReLU units before the amplitudes; 0 for no such layer.
        bias: standard deviation of b at the start. W starts by He's rule.
        branch: what each register sees. joint: all features. amplitude: the last one sees the direction alone, the
            others the rest (dual-branch). bloch: the same, and the last register's qubits point in the direction
            (`BlochRegister`). Both need color.directions=raw.
        joint: one circuit on all registers. false: every register has a circuit of its own and is measured by itself
            (parallel small circuits).
        unitary: circuit, or a control, see `Unitaries`.
        layers: of the circuit, in each of the uploads + 1 blocks: rotations and a ring of CZ.
        rotations: RY (real) or Rot (complex) on every wire in each layer.
        uploads: RZ encodings of a second linear map of the features, behind the amplitudes.
        frequencies: factors on the encoded angles. fixed: 1. ternary: trained from 1, 3, 9, ... (arXiv:2602.23409).
        values: Z of every wire; ZZ: also of all pairs.
        gain: factor on the values.
        readout: the last linear map. false: the first values are the outputs, times the gain.
    """

    quantum = True

    @classmethod
    def label(cls, options: Mapping[str, Any]) -> str:
        """`amplitude6`: qubits of the registers; then each option that is not the default."""
        parameters = HEADS.options("amplitude")
        parts = [f"amplitude{'+'.join(map(str, options['registers']))}"]
        for key, value in options.items():
            if key != "registers" and value != parameters[key].default:
                parts.append(value if isinstance(value, str) else f"{key}={str(value).lower()}")
        return "-".join(parts)

    @classmethod
    def without_effect(cls, options: Mapping[str, Any]) -> Collection[str]:
        controls = {"circuit": [], "local": [], "identity": ["layers", "rotations"]}
        found = controls.get(options["unitary"], ["layers"])
        if options["encoding"] == "none":
            found = [*found, "hidden", "bias", "branch"]
        if not options["uploads"]:
            found = [*found, "frequencies"]
        return found

    def __init__(
        self,
        in_dim: int,
        out_dim: int,
        *,
        registers: Annotated[list[Qubits], MinLen(1), MaxLen(MAX_QUBITS)] = [6],  # noqa: B006
        encoding: Encoding = "normalised",
        hidden: Annotated[int, Interval(ge=0, le=2**16)] = 0,
        bias: PositiveFactor = 0.3,
        branch: Literal["joint", "amplitude", "bloch"] = "joint",
        joint: bool = True,
        unitary: Kind = "circuit",
        layers: Annotated[int, Interval(ge=1, le=64)] = 4,
        rotations: Literal["RY", "Rot"] = "RY",
        uploads: Annotated[int, Interval(ge=0, le=16)] = 0,
        frequencies: Literal["fixed", "ternary"] = "fixed",
        values: Values = "ZZ",
        gain: Factor = 6.0,
        readout: bool = True,
    ) -> None:
        super().__init__()
        if joint and sum(registers) > MAX_QUBITS:
            raise ValueError(
                f"registers must have at most {MAX_QUBITS} qubits together, got {list(registers)}; or set joint=false"
            )
        if encoding == "none" and not uploads:
            raise ValueError("encoding=none expects uploads of at least 1: else the state holds no features")
        self.gain = gain
        self.out_dim = out_dim
        self.direction_features = DIRECTION if branch != "joint" and encoding != "none" else 0
        if self.direction_features >= in_dim or (self.direction_features and len(registers) < 2):
            raise ValueError(
                f"branch={branch} expects two registers and more than {DIRECTION} features, "
                f"got registers {list(registers)} and {in_dim} features"
            )
        options = {"encoding": encoding, "bias": bias, "hidden": hidden}
        sizes = [in_dim - self.direction_features] * len(registers)
        if self.direction_features:
            sizes[-1] = self.direction_features  # the last register sees the direction alone
        made = _made(sizes, registers, points=branch == "bloch", **options) if encoding != "none" else []
        self.groups = [range(len(registers))] if joint else [range(i, i + 1) for i in range(len(registers))]
        self.systems = nn.ModuleList()
        for group in self.groups:
            wires = sum(registers[index] for index in group)
            unitaries = Unitaries(wires, uploads + 1, kind=unitary, layers=layers, rotations=rotations)
            own = [made[index] for index in group] if made else []
            self.systems.append(System(own, wires, in_dim, unitaries, frequencies, values))
        self.counts = [len(system.measured) for system in self.systems]  # type: ignore[arg-type]
        self.readout = self._readout(in_dim) if readout else None
        if self.readout is None and sum(self.counts) < out_dim:
            raise ValueError(
                f"readout=false expects at least {out_dim} values, got {sum(self.counts)}; "
                "take values=ZZ or more qubits"
            )

    @torch.no_grad()
    def _readout(self, in_dim: int) -> nn.Linear:
        """The last linear map, which maps zero features to zero."""
        readout = nn.Linear(sum(self.counts), self.out_dim)
        if not readout.weight.is_meta:
            nn.init.kaiming_normal_(readout.weight, nonlinearity="relu")
            readout.bias.copy_(-self._values(torch.zeros(1, in_dim), readout.weight)[0])
        return readout

    def forward(self, features: Tensor) -> Tensor:
        """(N, in_dim) -> (N, out_dim)."""
        if self.readout is None:
            weights = torch.eye(self.out_dim, sum(self.counts), dtype=features.dtype, device=features.device)
            return self._values(features, weights)
        return self._values(features, self.readout.weight) + self.readout.bias

    def _values(self, features: Tensor, weights: Tensor) -> Tensor:
        """The values of all systems times the gain and weights (out, values): (N, out)."""
        direction, rest = features[:, : self.direction_features], features[:, self.direction_features :]
        parts = [rest] * sum(map(len, self.groups))
        if self.direction_features:
            parts[-1] = direction
        values = [
            system([parts[index] for index in group], features, own)
            for system, group, own in zip(
                self.systems, self.groups, (self.gain * weights).split(self.counts, 1), strict=True
            )
        ]
        return sum(values[1:], values[0])
