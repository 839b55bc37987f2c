"""exp, expm1 and log in compiled loops against NumPy in float64: kernels/exponentials.py."""

import numpy as np
import pytest

from qnerf.kernels import exponentials
from qnerf.kernels.jit import jit

SPECIAL = np.array([0.0, -np.inf, np.nan, -104.5, -1e30, -1e-40], np.float32)


@jit
def _exp(x, out):
    for i in range(x.size):
        out[i] = exponentials.exp(x[i])


@jit
def _expm1(x, out):
    for i in range(x.size):
        out[i] = exponentials.expm1(x[i])


@jit
def _log(x, out):
    for i in range(x.size):
        out[i] = exponentials.log(x[i])


LOOPS = {"exp": (_exp, np.exp), "expm1": (_expm1, np.expm1), "log": (_log, np.log)}


def inputs(name: str) -> np.ndarray:
    random = np.random.default_rng(0)
    wide = random.uniform(-100, 88, 20_000)
    near = random.normal(0, 1e-3, 2_000)
    if name == "log":
        return np.concatenate([np.exp(wide), 1 + near, [1e-40, 1e-45]])
    return np.concatenate([wide if name == "exp" else -abs(wide), -abs(near)])


@pytest.mark.parametrize("name", LOOPS)
def test_exponentials_are_within_a_few_roundings(name):
    loop, exact = LOOPS[name]
    x = inputs(name).astype(np.float32)
    found = np.empty_like(x)
    loop(x, found)
    expected = exact(x.astype(np.float64))
    rounding = np.spacing(np.abs(expected).astype(np.float32)).astype(np.float64)
    assert (np.abs(found - expected) <= 1.5 * rounding).all()
    in_float64 = np.empty(len(x))
    loop(x.astype(np.float64), in_float64)
    np.testing.assert_allclose(in_float64, expected, rtol=1e-14)


@pytest.mark.parametrize("name", ["exp", "expm1"])
def test_exponentials_of_infinity_and_nan(name):
    loop, exact = LOOPS[name]
    found = np.empty_like(SPECIAL)
    loop(SPECIAL, found)
    np.testing.assert_allclose(found, exact(SPECIAL), rtol=1e-6, atol=1e-44)
