"""exp, expm1 and log in compiled loops against NumPy in float64: kernels/exponentials.py."""

import numba
import numpy as np
import pytest

from qnerf.kernels import exponentials

SPECIAL = np.array([0.0, -np.inf, np.nan, -104.5, -1e30, -1e-40], np.float32)


FUNCTIONS = {
    "exp": (numba.vectorize(lambda x: exponentials.exp(x)), np.exp),
    "expm1": (numba.vectorize(lambda x: exponentials.expm1(x)), np.expm1),
    "log": (numba.vectorize(lambda x: exponentials.log(x)), np.log),
}


def inputs(name):
    random = np.random.default_rng(0)
    wide = random.uniform(-100, 88, 20_000)
    near = random.normal(0, 1e-3, 2_000)
    if name == "log":
        return np.concatenate([np.exp(wide), 1 + near, [1e-40, 1e-45]])
    return np.concatenate([wide if name == "exp" else -abs(wide), -abs(near)])


@pytest.mark.parametrize("name", FUNCTIONS)
def test_exponentials_are_within_a_few_roundings(name):
    ours, exact = FUNCTIONS[name]
    x = inputs(name).astype(np.float32)
    found = ours(x)
    assert found.dtype == np.float32
    expected = exact(x.astype(np.float64))
    rounding = np.spacing(np.abs(expected).astype(np.float32)).astype(np.float64)
    assert (np.abs(found - expected) <= 1.5 * rounding).all()
    np.testing.assert_allclose(ours(x.astype(np.float64)), expected, rtol=1e-14)


@pytest.mark.parametrize("name", ["exp", "expm1"])
def test_exponentials_of_infinity_and_nan(name):
    ours, exact = FUNCTIONS[name]
    np.testing.assert_allclose(ours(SPECIAL), exact(SPECIAL), rtol=1e-6, atol=1e-44)
