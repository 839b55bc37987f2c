"""What a circuit can express, how much it entangles, and how its weights and its inputs shape what it computes.

Each is a function of a layer (`tangent_kernel` of any module), in float64 and without shots or noise. Weights of None
are drawn anew for every state or point: every angle uniform in [0, 2 pi]. Inputs are angles in radians.

>>> from qnerf import QuantumLayer
>>> torch.manual_seed(0) and None
>>> round(entangling_capability(QuantumLayer(4, 1), states=2000).mean, 1)
0.7
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log, pi, sqrt

import torch
from torch import Tensor, nn
from torch.func import functional_call, jacrev, vmap

from qnerf.quantum.angles import offsets
from qnerf.quantum.circuit import Circuit, Gate
from qnerf.quantum.cones import TooLarge, scales_of
from qnerf.quantum.effects import without_effect as without_effect
from qnerf.quantum.hardware_conditions import conditions, require_layers
from qnerf.quantum.layer import QuantumLayer
from qnerf.quantum.program import program
from qnerf.quantum.simulator import Simulator
from qnerf.quantum.statevector import gate_by_gate

BINS = 75
AT_ONCE = 2**23  # amplitudes or derivatives


@dataclass(frozen=True)
class Estimate:
    """A mean over random states and its standard error."""

    mean: float
    standard_error: float


def weights_of(layer: QuantumLayer) -> Tensor:
    """The weights of a layer, flat (P,), float64."""
    own = [getattr(layer, name).detach().double().cpu().flatten() for name in layer.circuit.parameters]
    return torch.cat([torch.zeros(0, dtype=torch.float64), *own])


def random_weights(layer: QuantumLayer, count: int) -> Tensor:
    """Weights (count, P), every angle uniform in [0, 2 pi].

    Weights that start from a value of their own, such as scales, keep what the layer has.
    """
    own = weights_of(layer)
    drawn = uniform_angles(count, len(own))
    first = offsets(layer.circuit.parameters)
    for weights in layer.circuit.weights:
        if weights.initial is not None:
            part = slice(first[weights.name], first[weights.name] + weights.size)
            drawn[:, part] = own[part]
    return drawn


def uniform_angles(count: int, *shape: int) -> Tensor:
    """(count, *shape) angles, uniform in [0, 2 pi], from torch's global generator."""
    return torch.rand(count, *shape, dtype=torch.float64) * (2 * pi)


def states(circuit: Circuit, x: Tensor, weights: Tensor) -> Tensor:
    """The states (B, 2^n) at inputs x (B, features), complex128. Weights are (P,), shared by all samples, or (B, P)."""
    if weights.ndim == 1:
        return gate_by_gate(circuit, x, weights)
    at_once = max(1, AT_ONCE // 2**circuit.wires)
    one = vmap(lambda x, weights: gate_by_gate(circuit, x[None], weights)[0])
    return torch.cat([one(*part) for part in zip(x.split(at_once), weights.split(at_once), strict=True)])


def _sampled_states(layer: QuantumLayer, count: int, x: Tensor | None, trained: bool) -> Tensor:
    """States (count, 2^n): of inputs that are drawn from the given ones, or uniform."""
    require_layers(layer)
    features = layer.circuit.features or 0
    inputs = uniform_angles(count, features) if x is None else x.double().cpu()[torch.randint(len(x), (count,))]
    weights = weights_of(layer) if trained else random_weights(layer, count)
    with torch.no_grad():
        return states(layer.circuit, inputs, weights)


def expressibility(layer: QuantumLayer, *, pairs: int = 5000, x: Tensor | None = None, trained: bool = False) -> float:
    """How far the circuit's states are from uniformly random (Haar) ones: a divergence in nats; 0 is most expressive.

    KL(P || P_Haar) of the fidelity `F = |<psi|phi>|^2` of pairs of states (Eq. 7 and 8, arXiv:1905.10876), over a
    histogram of 75 bins. The bins have equal probability for Haar states, whose 1 - (1 - F)^(2^n - 1) is uniform; bins
    of equal width in F would hold all states of 8 wires in the first one. With finitely many pairs even Haar states
    have about 74 / (2 pairs). A circuit that does nothing has log 75 = 4.32, the largest value.

    Args:
        layer: its circuit.
        pairs: of states.
        x: inputs (B, n) in radians to draw from; None for uniform ones.
        trained: with the layer's own weights instead of random ones: how expressive the encoding is.
    """
    drawn = _sampled_states(layer, 2 * pairs, x, trained)
    return _divergence((drawn[:pairs].conj() * drawn[pairs:]).sum(1).abs().square(), layer.wires)


def _divergence(fidelities: Tensor, wires: int) -> float:
    uniform = 1 - (1 - fidelities.clamp(0, 1)) ** (2**wires - 1)
    share = torch.histc(uniform, BINS, 0, 1) / len(uniform)
    return float(torch.special.xlogy(share, share * BINS).sum())


def meyer_wallach(states: Tensor) -> Tensor:
    """Entanglement of states (B, 2^n): 2 (1 - mean over wires of tr rho_k^2), from 0 (product) to 1 (GHZ): (B,).

    Eq. 2 of arXiv:quant-ph/0305094.
    """
    n = states.shape[1].bit_length() - 1
    purity = torch.zeros(len(states), dtype=states.real.dtype, device=states.device)
    for wire in range(n):
        parts = states.reshape(-1, 2**wire, 2, 2 ** (n - wire - 1)).transpose(1, 2).reshape(len(states), 2, -1)
        rho = parts @ parts.mH
        purity += (rho.abs().square()).sum((1, 2)) / n
    return 2 * (1 - purity)


def entangling_capability(
    layer: QuantumLayer, *, states: int = 2000, x: Tensor | None = None, trained: bool = False
) -> Estimate:
    """Mean Meyer-Wallach entanglement of the circuit's states (Eq. 12, arXiv:1905.10876). For x, trained see above."""
    values = meyer_wallach(_sampled_states(layer, states, x, trained))
    return Estimate(float(values.mean()), float(values.std()) / sqrt(states))


def fisher(layer: QuantumLayer, x: Tensor, weights: Tensor | None = None) -> Tensor:
    """Fisher information (P, P) of the measured bit strings in the P weights, averaged over inputs x (B, n).

    F = mean_x sum_b d_i p(b|x) d_j p(b|x) / p(b|x): how well the angles could be told from what a device reads. The
    order is that of `weights_of`. `weights` of None are the layer's own. Where the circuit measures each wire in one
    basis, it is read there, else in the computational basis.
    """
    require_layers(layer)
    circuit = _as_read(layer.circuit)
    point = weights_of(layer) if weights is None else weights.double()
    size = point.numel()

    def probabilities(weights: Tensor, x: Tensor) -> Tensor:
        return gate_by_gate(circuit, x[None], weights)[0].abs().square()

    total = torch.zeros(size, size, dtype=torch.float64)
    for part in x.double().cpu().split(max(1, AT_ONCE // (16 * size * 2**layer.wires))):
        derivatives = vmap(jacrev(probabilities), in_dims=(None, 0))(point, part).reshape(len(part), -1, size)
        p = vmap(probabilities, in_dims=(None, 0))(point, part)
        scaled = derivatives * torch.where(p > 1e-14, p, torch.inf).rsqrt()[..., None]
        flat = scaled.reshape(-1, size)
        total += flat.T @ flat
    return total / len(x)


def _as_read(circuit: Circuit) -> Circuit:
    """The circuit with a rotation on each wire that it measures in X or Y alone, which makes that Z."""
    letters: dict[int, set[str]] = {}
    for observable in circuit.observables:
        for wire, letter in observable if isinstance(observable, tuple) else ():
            letters.setdefault(wire, set()).add(letter)
    turns = {"X": ("RY", -pi / 2), "Y": ("RX", pi / 2)}
    one = {wire: "".join(found) for wire, found in letters.items()}
    read = tuple(Gate(turns[a][0], (wire,), (turns[a][1],)) for wire, a in one.items() if a in turns)
    every_word = all(isinstance(observable, tuple) for observable in circuit.observables)
    same_basis = every_word and all(len(found) == 1 for found in one.values())
    return replace(circuit, operations=(*circuit.operations, *read)) if same_basis else circuit


def effective_dimension(matrices: Sequence[Tensor], samples: int, gamma: float = 1.0) -> float:
    """Effective dimension of Fisher matrices (P, P) at points of the weights, from 0 to P (Eq. 2, arXiv:2011.00027).

    With k = gamma samples / (2 pi log samples), 2 log(mean sqrt(det(1 + k F'))) / log k, where F' are the matrices
    scaled so that the mean of their traces is P. One matrix gives the local effective dimension at its point.
    """
    if not 0 < gamma <= 1 or samples < 2 or (k := gamma * samples / (2 * pi * log(samples))) <= 1:
        raise ValueError(f"effective dimension expects 0 < gamma <= 1 and more samples, got {gamma} and {samples}")
    stack = torch.stack(tuple(matrices))
    size = stack.shape[-1]
    trace = stack.diagonal(dim1=1, dim2=2).sum(1).mean()
    eigenvalues = torch.linalg.eigvalsh(stack * (size / trace)).clamp(min=0)
    halves = (1 + k * eigenvalues).log().sum(1) / 2
    return float(2 * (halves.logsumexp(0) - log(len(stack))) / log(k))


def tangent_kernel(module: nn.Module, x: Tensor) -> Tensor:
    """The tangent kernel (B, B) of a module at inputs x (B, in): K_ab = sum over outputs of grad f(x_a) . grad f(x_b).

    The gradients are in all parameters that train. Under gradient flow the outputs change by -K times the gradient of
    the loss in them, so errors along eigenvectors with small eigenvalues stay for long (arXiv:1806.07572).
    """
    trained = {name: p.detach() for name, p in module.named_parameters() if p.requires_grad}

    def outputs(parameters: dict[str, Tensor], x: Tensor) -> Tensor:
        values: Tensor = functional_call(module, parameters, (x[None],))
        return values.reshape(-1)

    rows: list[Tensor] = []
    with conditions(module, gradients=True):  # exact
        for part in x.split(16):
            derivatives = vmap(jacrev(outputs), in_dims=(None, 0))(trained, part)
            rows.append(torch.cat([each.flatten(2) for each in derivatives.values()], 2).double())
    jacobian = torch.cat(rows)
    return torch.einsum("aop,bop->ab", jacobian, jacobian)


@dataclass(frozen=True)
class Surrogate:
    """A classical model of a circuit: least squares on waves of its own spectrum.

    Attributes:
        waves: number of frequency vectors; each has a cosine and a sine, the zero vector a constant.
        covered: whether these are all frequencies of the circuit, so that the model is exact up to rounding.
        error: root mean square difference from the circuit on inputs that were not fitted, relative to the standard
            deviation of the circuit's outputs there: 0 is exact, 1 no better than the mean.
    """

    waves: int
    covered: bool
    error: float


def surrogate(layer: QuantumLayer, fitted: Tensor, tested: Tensor, waves: int) -> Surrogate:
    """Fits a classical surrogate to the circuit's outputs at inputs (B, n) and tests it at others (arXiv:2206.11740).

    A circuit is a sum of waves whose frequencies are known: each encoding adds -scale, 0 or scale to its wire. If the
    whole spectrum has more than `waves` vectors, as many are drawn, each encoding's part being the difference of two of
    its eigenvalues (random Fourier features, arXiv:2210.13200).
    """
    require_layers(layer)
    frequencies, covered = _frequencies(_encodings(layer.circuit), waves)
    with torch.no_grad():
        targets, expected = (_exact(layer, x) for x in (fitted, tested))
    features = [_waves(x.double().cpu(), frequencies) for x in (fitted, tested)]
    coefficients = torch.linalg.lstsq(features[0], targets, driver="gelsy", rcond=1e-14).solution
    off = (features[1] @ coefficients - expected).square().mean()
    spread = expected.var(0, correction=0).mean()
    return Surrogate(len(frequencies), covered, float((off / spread).sqrt()) if spread > 0 else float(off.sqrt()))


def _exact(layer: QuantumLayer, x: Tensor) -> Tensor:
    return Simulator(layer.circuit)(x.double().cpu(), weights_of(layer))


def _waves(x: Tensor, frequencies: Tensor) -> Tensor:
    phases = x @ frequencies.T
    return torch.cat([phases.cos(), phases[:, 1:].sin()], 1)  # the first vector is 0


def _frequencies(encodings: Tensor, count: int) -> tuple[Tensor, bool]:
    """Frequency vectors (waves, features), 0 first and one of each pair k, -k, and whether they are all there are.

    encodings: (encodings, features); each adds its row, or minus its row, or nothing.
    """
    vectors = torch.zeros(1, encodings.shape[1], dtype=torch.float64)
    for step in encodings:
        vectors = _distinct(torch.cat([vectors - step, vectors, vectors + step]))
        if len(vectors) > 2 * count - 1:
            break
    else:
        return _halved(vectors), True
    signs = torch.tensor([-1.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    found = torch.zeros(1, encodings.shape[1], dtype=torch.float64)
    for _ in range(100):
        drawn = signs[torch.randint(4, (4 * count, len(encodings)))] @ encodings
        found = _halved(torch.cat([found, drawn, -drawn]))
        if len(found) >= count:
            kept = 1 + torch.randperm(len(found) - 1)[: count - 1]
            return torch.cat([found[:1], found[kept]]), False
    return found, False


def _encodings(circuit: Circuit) -> Tensor:
    """(encodings, features): what each rotation that takes in a feature multiplies it by.

    Raises:
        ValueError: an angle or a start that is another function of the input, so the spectrum is not known.
    """
    own = program(circuit)
    try:
        if own.start_moves:
            raise TooLarge("its start depends on the input")
        scales = scales_of(own.blocks, circuit)
    except TooLarge as error:
        raise ValueError(f"surrogate expects a circuit whose spectrum is known, got {circuit.name}: {error}") from None
    rows = [(feature, factor) for feature, factors in scales.items() for factor in factors]
    out = torch.zeros(len(rows), circuit.features or 0, dtype=torch.float64)
    for row, (feature, factor) in enumerate(rows):
        out[row, feature] = factor
    return out


def _distinct(vectors: Tensor) -> Tensor:
    return torch.unique((vectors * 1e9).round(), dim=0) / 1e9


def _halved(vectors: Tensor) -> Tensor:
    """One of each pair k, -k: 0 first, then those whose first component that is not 0 is positive."""
    vectors = _distinct(vectors)
    first = vectors.gather(1, (vectors != 0).to(torch.int8).argmax(1, keepdim=True))[:, 0]
    return torch.cat([torch.zeros(1, vectors.shape[1], dtype=vectors.dtype), vectors[first > 0]])
