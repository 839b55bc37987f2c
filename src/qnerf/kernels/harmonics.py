"""Spherical harmonics of directions: a compiled CPU loop.

The plain PyTorch reference is in `qnerf.encoders.directions`.
"""

import torch
from torch import Tensor

from qnerf.kernels.hashgrid import U
from qnerf.kernels.jit import jit, run

GRAIN = 4096  # directions that are worth waking a thread for


def harmonics(directions: Tensor, degree: int) -> Tensor:
    """Bands 0..degree - 1 of directions (..., 3): (..., degree^2)."""
    out = torch.empty(*directions.shape[:-1], degree**2, dtype=directions.dtype)
    run(_harmonics, directions.numel() // 3, directions, degree, out, grain=GRAIN)
    return out


@jit
def _harmonics(start, stop, directions, degree, out):  # type: ignore[no-untyped-def]
    """Writes the harmonics of directions start..stop: the reference's polynomials, in its order."""
    n = directions.dtype.type
    count = U(degree * degree)
    for i in range(U(start), U(stop)):
        x, y, z = directions[U(3) * i], directions[U(3) * i + U(1)], directions[U(3) * i + U(2)]
        first = i * count
        out[first] = n(0.28209479177387814)
        if degree > 1:
            out[first + U(1)], out[first + U(2)] = n(0.4886025119029199) * y, n(0.4886025119029199) * z
            out[first + U(3)] = n(0.4886025119029199) * x
        xx, yy, zz = x * x, y * y, z * z
        if degree > 2:
            out[first + U(4)] = n(1.0925484305920792) * x * y
            out[first + U(5)] = n(1.0925484305920792) * y * z
            out[first + U(6)] = n(0.9461746957575601) * zz - n(0.31539156525252005)
            out[first + U(7)] = n(1.0925484305920792) * x * z
            out[first + U(8)] = n(0.5462742152960396) * (xx - yy)
        if degree > 3:
            five = n(5) * zz
            out[first + U(9)] = n(0.5900435899266435) * y * (n(3) * xx - yy)
            out[first + U(10)] = n(2.890611442640554) * x * y * z
            out[first + U(11)] = n(0.4570457994644658) * y * (five - n(1))
            out[first + U(12)] = n(0.3731763325901154) * z * (five - n(3))
            out[first + U(13)] = n(0.4570457994644658) * x * (five - n(1))
            out[first + U(14)] = n(1.445305721320277) * z * (xx - yy)
            out[first + U(15)] = n(0.5900435899266435) * x * (xx - n(3) * yy)
