"""The Fourier spectrum of a run's circuits in their input angles.

A measured value f is a trigonometric polynomial of its n angles, of degree D_w = sum_s |scale_s| / base in angle w
(arXiv:2008.08605). With c_k its coefficients, k in prod_w {-D_w, ..., D_w}, the power of angle w at frequency m is

    P_w(m) = sum over k with |k_w| = m of |c_k|^2,        sum_m P_w(m) = E f^2,

the mean over uniform angles of the squared part of f that has frequency m in angle w. If the values of f on the whole
grid of 2 D_w + 1 equispaced angles for each wire fit into memory, a discrete Fourier transform gives all powers without
error (method "exact"). Otherwise the transform is taken along one angle and the mean over the others by scrambled
Sobol points; independent scramblings give the standard error (method "sobol").
"""

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import pandas as pd
import torch

from qnerf.heads.qiren import HybridLayer
from qnerf.probes.trained import Trained
from qnerf.quantum import QuantumLayer
from qnerf.quantum.circuit import Circuit
from qnerf.quantum.cones import Cone, TooLarge, cones_of_outputs, scales_of
from qnerf.quantum.diagnostics import weights_of
from qnerf.quantum.program import program
from qnerf.quantum.simulator import Simulator

MAX_VALUES = 20_000_000  # float64 values on the grid of one cone, 160 MB: 8 wires up to S = 2
CHUNK = 2**14  # samples for each call of the engine
SCRAMBLINGS = 16
POINTS = 1024  # of each scrambling


def table(trained: Trained) -> pd.DataFrame:
    """One row for each circuit, output, angle (wire) and frequency.

    Columns: head (density | color), circuit (0: the first hybrid layer), output, wire, frequency (radians^-1), power
    and its standard_error (0 where exact), mean (c_0) and variance (E f^2 - c_0^2) of the output over uniform angles,
    method (exact | sobol), and angle_mean, angle_std: this angle over the training samples according to the
    normalisation before the circuit, radians (NaN for circuits without one).

    Raises:
        ValueError: the run has no circuit.
    """
    parts = []
    for name, circuits in trained.circuits().items():
        for index, (place, circuit) in enumerate(circuits.items()):
            layer = trained.heads[name].get_submodule(place.rpartition(".")[0])
            rows = powers(circuit).merge(angles(layer, circuit.wires), on="wire")
            parts.append(rows.assign(head=name, circuit=index))
    rows = pd.concat(parts, ignore_index=True)
    return rows[["head", "circuit", *rows.columns.drop(["head", "circuit"])]]


def angles(layer: torch.nn.Module, wires: int) -> pd.DataFrame:
    """Columns wire, angle_mean, angle_std (radians): a hybrid layer's angles over the training samples.

    The normalisation gives mean 0 and variance 1 before its own shift and scale, so these and the layer's input_scale
    are enough. NaN if the statistics stay as in the first batch.
    """
    if not isinstance(layer, HybridLayer) or layer.norm.statistics != "batch":
        return pd.DataFrame({"wire": range(wires), "angle_mean": np.nan, "angle_std": np.nan})
    mean, std = (p.detach().double().cpu().numpy() * layer.input_scale for p in (layer.norm.bias, layer.norm.weight))
    return pd.DataFrame({"wire": range(wires), "angle_mean": mean, "angle_std": np.abs(std)})


def powers(layer: QuantumLayer, *, max_values: int = MAX_VALUES) -> pd.DataFrame:
    """The spectrum of a circuit with its present weights, in float64 and without noise.

    Columns output, wire, frequency, power, standard_error, mean, variance, method. For a wire outside an output's light
    cone all power is at frequency 0. `max_values` limits the grid of the exact method.
    """
    circuit = layer.circuit
    values = _evaluator(layer)
    cones, bases = _cones(circuit)
    shared: dict[Cone, list[int]] = {}
    for output, cone in enumerate(cones):
        shared.setdefault(cone, []).append(output)
    parts = []
    for cone, outputs in shared.items():
        exact = cone.coefficients * len(circuit.observables) <= max_values
        method = _exact if exact else _sobol
        for output, rows in method(values, circuit.wires, cone, outputs, bases):
            rows["frequency"] *= np.array(bases)[rows["wire"]]
            parts.append(rows.assign(output=output, method=method.__name__.removeprefix("_")))
    table = pd.concat(parts, ignore_index=True).sort_values(["output", "wire", "frequency"], ignore_index=True)
    return table[["output", "wire", "frequency", "power", "standard_error", "mean", "variance", "method"]]


Values = Callable[[np.ndarray], np.ndarray]
"""Angles (B, n) in radians -> outputs (B, outputs), float64."""


def _evaluator(layer: QuantumLayer) -> Values:
    simulator = Simulator(layer.circuit, "statevector")
    weights = weights_of(layer)

    def values(x: np.ndarray) -> np.ndarray:
        parts = [simulator(part, weights).numpy() for part in torch.from_numpy(x).split(CHUNK)]
        return np.concatenate(parts)

    return values


def _cones(circuit: Circuit) -> tuple[tuple[Cone, ...], tuple[float, ...]]:
    """The light cones and base frequencies. If cones are large, every output is taken to depend on every wire."""
    try:
        cones = cones_of_outputs(program(circuit))
        return cones.cones, tuple(base or 1.0 for base in cones.base_frequencies)
    except TooLarge:
        scales = scales_of(program(circuit).blocks, circuit)
        bases = [min(map(abs, scales.get(feature, [1.0]))) for feature in range(circuit.features or 0)]
        degrees = np.array([sum(map(abs, scales.get(k, []))) / base for k, base in enumerate(bases)])
        if not np.allclose(degrees, degrees.round()):
            raise ValueError(f"spectrum: expected encoding scales with a common unit, got {scales}") from None
        cone = Cone(tuple(range(len(bases))), tuple(int(degree) for degree in degrees.round()))
        return (cone,) * circuit.outputs, tuple(bases)


def _exact(
    values: Values, wires: int, cone: Cone, outputs: list[int], bases: Sequence[float]
) -> Iterator[tuple[int, pd.DataFrame]]:
    """Fourier transform of the values on the cone's whole grid."""
    sizes = [2 * degree + 1 for degree in cone.degrees]
    results = np.empty((math.prod(sizes), len(outputs)))
    for start in range(0, len(results), CHUNK):
        flat = np.arange(start, min(start + CHUNK, len(results)))
        x = np.zeros((len(flat), wires))
        for wire, size, index in zip(cone.features, sizes, np.unravel_index(flat, sizes), strict=True):
            x[:, wire] = index * (2 * np.pi / size / bases[wire])
        results[flat] = values(x)[:, outputs]
    for column, output in enumerate(outputs):
        spectrum = np.fft.fftn(results[:, column].reshape(sizes), norm="forward")
        power = spectrum.real**2 + spectrum.imag**2
        mean = spectrum.flat[0].real
        total = power.sum()
        rows = []
        for wire in range(wires):
            if wire not in cone.features:
                rows.append((wire, 0, total))
                continue
            axis = cone.features.index(wire)
            one_sided = power.sum(tuple(other for other in range(len(sizes)) if other != axis))
            rows += [(wire, m, p) for m, p in enumerate(_folded(one_sided[None])[0])]
        table = pd.DataFrame(rows, columns=["wire", "frequency", "power"])
        yield output, table.assign(standard_error=0.0, mean=mean, variance=total - mean**2)


def _sobol(
    values: Values, wires: int, cone: Cone, outputs: list[int], bases: Sequence[float]
) -> Iterator[tuple[int, pd.DataFrame]]:
    """Fourier transform along one angle, mean over scrambled Sobol points in the others."""
    estimates: dict[int, np.ndarray] = {}  # by wire: (scramblings, frequencies, outputs)
    means = np.empty((SCRAMBLINGS, len(outputs)))
    point_sets = [
        torch.quasirandom.SobolEngine(wires, scramble=True, seed=seed).draw(POINTS, dtype=torch.float64).numpy()
        for seed in range(SCRAMBLINGS)
    ]
    for wire, degree in zip(cone.features, cone.degrees, strict=True):
        size = 2 * degree + 1
        scrambled = []
        for number, points in enumerate(point_sets):
            x = np.repeat(points * (2 * np.pi / np.array(bases)), size, axis=0)
            x[:, wire] = np.tile(np.arange(size) * (2 * np.pi / size / bases[wire]), POINTS)
            lines = values(x)[:, outputs].reshape(POINTS, size, -1)
            spectrum = np.fft.fft(lines, axis=1, norm="forward")
            means[number] = lines.mean((0, 1))
            scrambled.append(_folded((spectrum.real**2 + spectrum.imag**2).transpose(0, 2, 1)).mean(0).T)
        estimates[wire] = np.stack(scrambled)
    for column, output in enumerate(outputs):
        mean = means[:, column].mean()
        tables = []
        for wire, powers_of_wire in estimates.items():
            power = powers_of_wire[..., column]
            error = power.std(0, ddof=1) / math.sqrt(SCRAMBLINGS)
            rows = pd.DataFrame({"power": power.mean(0), "standard_error": error})
            variance = power.sum(1).mean() - mean**2
            tables.append(rows.assign(wire=wire, frequency=range(len(rows)), mean=mean, variance=variance))
        yield output, pd.concat(tables, ignore_index=True)


def _folded(power: np.ndarray) -> np.ndarray:
    """Power (..., 2 D + 1) in the order of a Fourier transform -> (..., D + 1): frequencies m and -m added up."""
    degree = power.shape[-1] // 2
    both = power[..., : degree + 1].copy()
    both[..., 1:] += power[..., :degree:-1]
    return both
