"""Rotation vectors and twists -> rotations and rigid motions: the exponential maps of SO(3) and SE(3)."""

import torch
from torch import Tensor

# Taylor series of (theta - sin theta) / theta^3 in theta^2
_SERIES = [1 / 6, -1 / 120, 1 / 5040, -1 / 362880, 1 / 39916800, -1 / 6227020800, 1 / 1307674368000]


def sinc_of_square(square: Tensor) -> Tensor:
    """sin(theta) / theta as a function of theta^2 >= 0. It and its gradient are exact at 0.

    >>> sinc_of_square(torch.tensor([0.0, 1.0], dtype=torch.float64))
    tensor([1.0000, 0.8415], dtype=torch.float64)
    """
    small = square < 1e-3
    theta = torch.where(small, torch.ones_like(square), square).sqrt()
    near = torch.where(small, square, 0)  # a large series times 0 would be a NaN gradient
    series = 1 - near / 6 * (1 - near / 20 * (1 - near / 42))
    return torch.where(small, series, theta.sin() / theta)


def skew(vector: Tensor) -> Tensor:
    """Vectors v (..., 3) -> matrices (..., 3, 3) with skew(v) w = v x w.

    >>> skew(torch.tensor([1.0, 2.0, 3.0])).tolist()
    [[0.0, -3.0, 2.0], [3.0, 0.0, -1.0], [-2.0, 1.0, 0.0]]
    """
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).view(*vector.shape, 3)


def exp_so3(rotation: Tensor) -> Tensor:
    """Rotation vectors (..., 3), radians -> rotation matrices (..., 3, 3), by Rodrigues' formula.

    R = I + sin(theta)/theta K + (1 - cos(theta))/theta^2 K^2 with K = skew(vector). The last factor is computed as half
    the square of sin(theta/2) / (theta/2), which is accurate at small angles and near pi.

    >>> quarter_turn = exp_so3(torch.tensor([0.0, 0.0, torch.pi / 2]))
    >>> torch.allclose(quarter_turn @ torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 1.0, 0.0]), atol=1e-6)
    True
    """
    square = rotation.square().sum(-1)[..., None, None]
    k = skew(rotation)
    eye = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
    return eye + sinc_of_square(square) * k + 0.5 * sinc_of_square(square / 4).square() * (k @ k)


def _left_jacobian(rotation: Tensor) -> Tensor:
    """V = I + (1 - cos(theta))/theta^2 K + (theta - sin(theta))/theta^3 K^2, which maps a twist's translation part."""
    square = rotation.square().sum(-1)[..., None, None]
    k = skew(rotation)
    small = square < 1
    series = torch.full_like(square, _SERIES[-1])
    for coefficient in reversed(_SERIES[:-1]):
        series = series * torch.where(small, square, 0) + coefficient
    large = torch.where(small, torch.ones_like(square), square)
    cubic = torch.where(small, series, (1 - sinc_of_square(large)) / large)
    eye = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
    return eye + 0.5 * sinc_of_square(square / 4).square() * k + cubic * (k @ k)


def exp_se3(motion: Tensor) -> Tensor:
    """Twists (..., 6), translation part then rotation vector -> rigid motions [R | t] (..., 3, 4)."""
    rotation = motion[..., 3:]
    return torch.cat([exp_so3(rotation), _left_jacobian(rotation) @ motion[..., :3, None]], dim=-1)


def exp_so3xr3(motion: Tensor) -> Tensor:
    """Translations and rotation vectors (..., 6) -> rigid motions [R | t] (..., 3, 4)."""
    return torch.cat([exp_so3(motion[..., 3:]), motion[..., :3, None]], dim=-1)
