"""Circuits, and the normalisation before them."""

import math
from functools import partial

import torch
from torch import Tensor
from torch.func import functional_call

from benchmarks.accuracy_cases import ACCEPTED_GRADIENT, EPS, Case, Function, rounded
from qnerf.heads.qiren import Normalisation
from qnerf.quantum.circuit import ANSATZE, Circuit
from qnerf.quantum.compiled.engine import Engine
from qnerf.quantum.cones import TooLarge, find_cones
from qnerf.quantum.lightcone import LightCones
from qnerf.quantum.program import program

CIRCUIT_GRADIENTS = 1e-5
"""Of the inputs and of the weights, each relative to its largest, up to S = 6; beyond, and at 14 wires, where gradients
are a hundredth of the range, `ACCEPTED_GRADIENT`."""

NORMALISED = 32 * EPS
"""Of the largest normalised value, for up to 6,144 rows. They are added up one by one: their squares, all positive, are
within sqrt(6144) EPS / 2 of their sum where roundings are independent, and the root halves that. It does not depend on
the mean: a feature has been rounded to |mean| EPS / 2 before, and centring it rounds no further."""


def rows(circuit: Circuit) -> int:
    """Sublayers of QIREN, each with an angle (n, 3) for every wire."""
    return circuit.size // (3 * circuit.wires)


def output_error(circuit: Circuit) -> float:
    """Bound of a circuit's outputs in float32, of their range of 1: 3 sqrt(passes) EPS, whatever the angles are.

    A sublayer passes over the state once a wire (RY) and three times more (diagonals, measurement). A pass is a product
    and a sum, EPS / 2 each, and the roundings of different passes are independent: they add up like sqrt(passes), in an
    expectation value twice, with half as much again for its sum over the amplitudes. 8 wires, S = 2: 2.9e-6.
    """
    return 3 * math.sqrt(rows(circuit) * (circuit.wires + 3)) * EPS


def normalised_gradient_error(x: Tensor) -> float:
    """Bound of the gradient into the features, of the largest.

    Of a batch of 2 the normalised values are +1 and -1 whatever the features are: what is left of the gradient is
    1e-5 / var of its terms.
    """
    return ACCEPTED_GRADIENT * (1.0 if len(x) > 2 else float(1 + x.var(0, unbiased=False).max() / 1e-5))


def engines(circuit: Circuit) -> dict[str, Function]:
    """Variant -> function of inputs (B, n) and weights (rows, n, 3). "plain": the state vector in PyTorch."""
    engine = Engine(circuit)
    plain = engine.plain
    functions: dict[str, Function] = {
        "plain": lambda x, weights: plain.evaluate(x, weights.flatten()),
        "statevector": lambda x, weights: engine.evaluate(x, weights.flatten()),
    }
    try:
        cones = LightCones(find_cones(program(circuit)))
    except TooLarge:  # every output depends on too many inputs
        return functions
    return functions | {
        "lightcone": lambda x, w: cones.evaluate(plain, engine.simulate, x, w.flatten(), True),
        "lightcone plain": lambda x, w: cones.evaluate(plain, plain.simulate, x, w.flatten(), False),
    }


def _with_range(function: Function, x: Tensor, weights: Tensor) -> Tensor:
    """The outputs and a 1, so that errors are relative to the range and not to the largest output."""
    y = function(x, weights)
    return torch.cat([y.flatten(), y.new_ones(1)])


def angles(circuit: Circuit, *, inputs: float, weights: float, batch: int) -> tuple[Tensor, Tensor]:
    """Inputs (B, n), normally distributed, and weights (rows, n, 3), uniform from 0, of these sizes, in radians."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(batch, circuit.wires, generator=generator, dtype=torch.float64) * inputs
    w = torch.rand(rows(circuit), 3, circuit.wires, generator=generator, dtype=torch.float64) * weights
    return rounded(x), rounded(w.transpose(1, 2).contiguous())


def circuit_case(
    name: str, circuit: Circuit, *, inputs: float = 1.0, weights: float = 2 * math.pi, batch: int = 256
) -> Case:
    variants = {variant: partial(_with_range, function) for variant, function in engines(circuit).items()}
    gradient = ACCEPTED_GRADIENT if circuit.parameters["weights1"][0] > 6 or circuit.wires == 14 else CIRCUIT_GRADIENTS
    tensors = angles(circuit, inputs=inputs, weights=weights, batch=batch)
    return Case("circuits", name, variants, tensors, output_error(circuit), gradient)


def normalisation(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """The normalisation of a hybrid layer in training."""
    layer = Normalisation(x.shape[1]).to(x.dtype)
    return functional_call(layer, {"weight": weight, "bias": bias}, (x,))


def normalisation_plain(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """(x - mean) / sqrt(var + 1e-5) weight + bias, mean and variance over the batch."""
    centred = x - x.mean(0)
    centred = centred - centred.mean(0)  # the mean of numbers far from 0 is rounded to their size
    return centred / (centred.square().mean(0) + 1e-5).sqrt() * weight + bias


def normalisation_case(name: str, x: Tensor) -> Case:
    generator = torch.Generator().manual_seed(1)
    weight = rounded(torch.rand(x.shape[1], generator=generator, dtype=torch.float64) + 0.5)
    bias = rounded(torch.randn(x.shape[1], generator=generator, dtype=torch.float64))
    variants = {"fast": normalisation, "plain": normalisation_plain}
    x = rounded(x)
    return Case("normalisation", name, variants, (x, weight, bias), NORMALISED, normalised_gradient_error(x))


def cases() -> list[Case]:
    qiren = partial(ANSATZE.build, "qiren")
    random = torch.randn(6144, 8, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    constant = torch.cat([random[:, 1:], torch.full((6144, 1), 1e3, dtype=torch.float64)], dim=1)
    return [
        circuit_case("8 wires, S = 1", qiren(8, 1)),
        circuit_case("8 wires, S = 2", qiren(8, 2)),
        *(circuit_case(f"inputs of {size:.0e} rad", qiren(8, 1), inputs=size) for size in (1e3, 1e6, 1e30)),
        *(circuit_case(f"weights of {size:.0e} rad", qiren(8, 2), weights=size) for size in (1e3, 1e6, 1e30)),
        circuit_case("inputs of 1e+03 rad, scaled by 3^s", ANSATZE.build("ternary", 3, 2), inputs=1e3),
        circuit_case("8 wires, S = 32", qiren(8, 32), batch=32),
        circuit_case("1 wire, S = 32", qiren(1, 32)),
        circuit_case("14 wires, S = 1", qiren(14, 1), batch=4),
        circuit_case("14 wires, S = 2", qiren(14, 2), batch=4),
        normalisation_case("features of size 1", random),
        normalisation_case("batch of 2", random[:2]),
        normalisation_case("constant feature", constant),
        normalisation_case("offset of 100 standard deviations", 1 + random * 0.01),
        normalisation_case("offset of 1e+05 standard deviations", 1e3 + random * 0.01),
        normalisation_case("offset of 1e+06 standard deviations", 1e6 + random),
        normalisation_case("features of 1e+16", random * 1e16),  # beyond, the sum of their squares overflows float32
    ]
