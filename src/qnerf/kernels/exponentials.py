"""exp, expm1 and log of one float32 number as polynomials, which LLVM turns into vectors in a loop over many.

Numba calls a library function for each number, which takes five to ten times as long. The results are within a few
roundings of the exact ones. float64 takes the library's functions.
"""

from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import extending, types

_EXP = (0.5, 0.16666543, 0.0416672, 0.008366514, 0.0013882522)  # (e^r - 1 - r) / r^2, |r| <= log(2) / 2
_LOG = (0.33333331, -0.25000820, 0.20001227, -0.16623357, 0.14201757, -0.13160183, 0.12761577, -0.07634496)
# (log(1 + f) - f + f^2 / 2) / f^3, 1 + f from sqrt(1/2) to sqrt(2)
_FUSED: Any = {"fastmath": {"contract"}, "error_model": "numpy"}  # a * b + c may become one instruction


@extending.intrinsic
def _as_float(typing_context: Any, bits: Any) -> Any:
    """The float32 with these 32 bits."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.int32), generate


@extending.intrinsic
def _as_bits(typing_context: Any, number: Any) -> Any:
    """The 32 bits of a float32."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.IntType(32))

    return types.int32(types.float32), generate


@extending.register_jitable(**_FUSED)
def _split(x):  # type: ignore[no-untyped-def]
    """x = n log(2) + r with |r| <= log(2) / 2: e^r - 1, and 2^n as a product of two that are no denormal numbers."""
    f, i = np.float32, np.int32
    # Beyond these bounds e^x is 0 or infinite. Both comparisons are false for NaN, whose n must be an integer too.
    bounded = f(-104) if not x > f(-104) else (f(89) if x > f(89) else x)
    n = np.floor(bounded * f(1.44269504) + f(0.5))
    r = (bounded - n * f(0.693359375)) + n * f(2.12194440e-4)  # log(2) in two parts: the first product is exact
    p = f(_EXP[3]) + r * f(_EXP[4])
    p = f(_EXP[1]) + r * (f(_EXP[2]) + r * p)
    p = r + r * r * (f(_EXP[0]) + r * p)
    whole = i(n)
    half = i(whole >> i(1))
    low = _as_float(i(i(half + i(127)) << i(23)))
    high = _as_float(i(i(i(whole - half) + i(127)) << i(23)))
    return p, low, high


def exp(x: Any) -> Any:
    """e^x: 0 at -infinity, infinite above 88.7, NaN for NaN."""


def expm1(x: Any) -> Any:
    """e^x - 1 for x <= 0, also for tiny ones with all digits."""


def log(x: Any) -> Any:
    """Natural logarithm of x > 0, also of denormal numbers."""


@extending.overload(exp, jit_options=_FUSED)
def _exp(x):  # type: ignore[no-untyped-def]
    def fast(x):  # type: ignore[no-untyped-def]
        p, low, high = _split(x)
        return x if x != x else (np.float32(1) + p) * low * high

    return fast if x == types.float32 else lambda x: np.exp(x)


@extending.overload(expm1, jit_options=_FUSED)
def _expm1(x):  # type: ignore[no-untyped-def]
    def fast(x):  # type: ignore[no-untyped-def]
        p, low, high = _split(x)
        power = low * high
        return x if x != x else p * power + (power - np.float32(1))

    return fast if x == types.float32 else lambda x: np.expm1(x)


@extending.overload(log, jit_options=_FUSED)
def _log(x):  # type: ignore[no-untyped-def]
    def fast(x):  # type: ignore[no-untyped-def]
        f, i = np.float32, np.int32
        tiny = x < f(1.17549435e-38)
        bits = _as_bits(f(x * f(8388608)) if tiny else x)  # a denormal number times 2^23 is normal
        # x = 2^n (1 + g) with 1 + g from sqrt(1/2) to sqrt(2): the difference to the bits of sqrt(1/2) holds n.
        above = i(bits - i(0x3F3504F3))
        n = f(i(above >> i(23)) - (i(23) if tiny else i(0)))
        g = _as_float(i((above & i(0x7FFFFF)) + i(0x3F3504F3))) - f(1)
        p = f(_LOG[6]) + g * f(_LOG[7])
        p = f(_LOG[3]) + g * (f(_LOG[4]) + g * (f(_LOG[5]) + g * p))
        p = f(_LOG[0]) + g * (f(_LOG[1]) + g * (f(_LOG[2]) + g * p))
        small = g * g * (g * p - f(0.5))
        return x if x != x else n * f(0.693359375) + (g + (small - n * f(2.12194440e-4)))

    return fast if x == types.float32 else lambda x: np.log(x)
