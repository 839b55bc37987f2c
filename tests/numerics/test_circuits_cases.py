"""Circuits on hard cases: huge, infinite and NaN angles, many encodings, many wires, drift, vanishing gradients."""

import math
from itertools import product

import torch
from hypothesis import example, given
from hypothesis import strategies as st

from benchmarks.accuracy_cases.circuits import angles, engines, output_error, rows
from qnerf.quantum.circuit import ANSATZE

ENGINES = ("plain", "statevector", "lightcone", "lightcone plain")
SERIES = 6
"""The light-cone series in plain PyTorch sums products of coefficients with both signs, which near angles of 0 are all
rounded alike; 3.6 times the bound of the others is the worst of 10,000 random circuits."""
GRADIENTS = 20
"""A gradient is the difference of two outputs at shifted angles, half the sum of their errors each, and one of a weight
sums over a batch of 8 samples and up to 5 outputs with weights of up to 1: within 20 times the bound of the outputs."""


def test_infinite_and_nan_inputs_are_nan_and_spoil_no_other_sample():
    circuit = ANSATZE.build("qiren", 4, 1)
    others = torch.arange(40) != 17
    for engine, dtype, value in product(ENGINES, (torch.float32, torch.float64), (math.inf, -math.inf, math.nan)):
        function = engines(circuit)[engine]
        x, w = (t.to(dtype) for t in angles(circuit, inputs=1.0, weights=6.0, batch=40))
        sound = x.clone().requires_grad_()
        expected = function(sound, w)
        x[17, 2] = value
        x.requires_grad_()
        y = function(x, w)
        assert y[17].isnan().any()
        assert torch.equal(y[others], expected[others])
        (before,) = torch.autograd.grad(expected.sum(), sound)
        (after,) = torch.autograd.grad(y.sum(), x)
        assert torch.equal(after[others], before[others])
        assert after[17].isnan().any()


def test_nan_weights_are_nan_everywhere_they_reach():
    circuit = ANSATZE.build("qiren", 3, 1)
    x, w = angles(circuit, inputs=1.0, weights=6.0, batch=5)
    w[2, 1, 1] = math.nan
    for engine in ENGINES:
        assert engines(circuit)[engine](x, w).isnan().all(), engine


def gradient(function, x, w, g):
    x, w = x.clone().requires_grad_(), w.clone().requires_grad_()
    return torch.autograd.grad(function(x, w), (x, w), g)


def test_gradients_that_vanish_by_construction_are_exactly_zero():
    """A gradient of rounding noise is no zero for Adam, which moves such a weight by the whole learning rate."""
    circuit = ANSATZE.build("qiren", 5, 1)
    for engine, dtype in product(ENGINES, (torch.float32, torch.float64)):
        x, w = (t.to(dtype) for t in angles(circuit, inputs=1.0, weights=6.0, batch=33))
        _, dw = gradient(engines(circuit)[engine], x, w, torch.ones(33, 5, dtype=dtype))
        assert not dw[0, :, 0].any()  # phi of the first sublayer acts on |0...0>
        assert not dw[-1, :, 2].any()  # omega of the last one comes before a measurement of Z
        assert dw[0, :, 1].all()


def test_gradients_at_an_extremum_vanish_and_outputs_stay_in_range():
    """Without rotations, and with half turns, every output is +1 or -1 for all inputs: the flattest point there is."""
    circuit = ANSATZE.build("qiren", 4, 1)
    for engine, weights in product(ENGINES, (0.0, math.pi)):
        x, w = angles(circuit, inputs=1e3, weights=0.0, batch=64)
        w[:, :, 1] = weights
        x, w = x.float(), w.float()
        y = engines(circuit)[engine](x, w)
        assert (y.abs() <= 1).all()
        assert (1 - y.abs()).max() <= output_error(circuit)
        dx, dw = gradient(engines(circuit)[engine], x, w, torch.ones_like(y))
        assert dx.abs().max() <= GRADIENTS * output_error(circuit)
        assert dw.abs().max() <= 64 * output_error(circuit)  # half turns are off by 9e-8 in float32


corners = st.sampled_from([0.0, math.pi / 2, math.pi, -math.pi, 2 * math.pi, 1e3, 1e30])
LARGEST = 2.0**120  # radians: multiples of larger angles, which the series takes, overflow float32
anything = st.floats(-LARGEST, LARGEST, width=32) | st.floats(-7, 7, width=32)
shapes = st.sampled_from([(1, 1), (2, 3), (3, 1), (4, 2), (5, 1)])
seeds = st.integers(0, 2**31)


@given(shape=shapes, turned=corners, size=anything, seed=seeds)
@example(shape=(5, 1), turned=0.0, size=3.4028234663852886e38, seed=0)
def test_outputs_stay_within_minus_1_and_1(shape, turned, size, seed):
    """Weights at and around corners, where an expectation value is largest; inputs of any size."""
    circuit = ANSATZE.build("qiren", *shape)
    generator = torch.Generator().manual_seed(seed)
    near = torch.randint(0, 3, (rows(circuit), shape[0], 3), generator=generator) * 1e-4
    w = near + torch.tensor(turned)
    x = torch.rand(20, shape[0], generator=generator) * size
    for function in engines(circuit).values():
        y = function(x, w)
        assert y.dtype == torch.float32
        assert (y.abs() <= 1).all()  # false for NaN


@given(shape=shapes, inputs=anything, weights=anything, seed=seeds)
@example(shape=(4, 2), inputs=1e30, weights=1e30, seed=1)
@example(shape=(4, 2), inputs=0.0, weights=0.5, seed=0)
def test_float32_keeps_its_bounds_at_angles_of_any_size(shape, inputs, weights, seed):
    circuit = ANSATZE.build("qiren", *shape)
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(8, shape[0], generator=generator) * (inputs / 8)
    w = torch.randn(rows(circuit), shape[0], 3, generator=generator) * (weights / 8)
    g = torch.rand(8, shape[0], generator=generator)
    functions = engines(circuit)
    y = functions["plain"](x.double(), w.double())
    dx, dw = gradient(functions["plain"], x.double(), w.double(), g.double())
    for name, function in functions.items():
        bound = output_error(circuit) * (SERIES if name == "lightcone plain" else 1)
        assert (function(x, w) - y).abs().max() <= bound
        for actual, expected in zip(gradient(function, x, w, g), (dx, dw), strict=True):
            assert (actual - expected).abs().max() <= GRADIENTS * bound
