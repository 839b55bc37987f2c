"""Volume rendering: densities and colours of samples -> colour, depth and opacity of rays.

sigma is the density (R, K) per world unit, delta the length of an interval, T the transmittance up to it.
"""

from typing import Any

import torch
from torch import Tensor

from qnerf.types import Rendering, Samples

BACKGROUNDS = ("last_sample", "white", "black", "random")


def volume_weights(density: Tensor, delta: Tensor) -> Tensor:
    """Share of each interval in its ray's colour: w_i = (1 - e^(-sigma_i delta_i)) exp(-sum_{j<i} sigma_j delta_j).

    The weights of a ray sum to 1 - T(end): at most 1, up to K roundings. Any density from 0 to infinity is allowed and
    gives finite weights and gradients; an interval of length 0 weighs nothing. A NaN density stays NaN.

    Args:
        density: (R, K) per world unit, >= 0.
        delta: (R, K) world units, >= 0; taken as constant.

    Returns:
        (R, K) in [0, 1].
    """
    return _VolumeWeights.apply(density, delta)


def volume_weights_reference(density: Tensor, delta: Tensor) -> Tensor:
    """`volume_weights` in plain PyTorch, differentiated by autograd."""
    thickness = _thickness(density, delta)
    before = torch.nn.functional.pad(thickness.cumsum(-1)[:, :-1], (1, 0))
    # Autograd has the derivative e^-x of 1 - e^-x from its value, whose digits end where it is nearly 1.
    opacity = torch.where(thickness < 1, -torch.expm1(-thickness), 1 - torch.exp(-thickness))
    return opacity * torch.exp(-before)


def _thickness(density: Tensor, delta: Tensor) -> Tensor:
    """Optical thickness sigma delta, with infinity times 0 = 0."""
    return density.clamp(max=torch.finfo(density.dtype).max) * delta


class _VolumeWeights(torch.autograd.Function):
    """With x = sigma delta: dw_i/dx_i = T_(i+1), dw_j/dx_i = -w_j for j > i."""

    @staticmethod
    def forward(ctx: Any, density: Tensor, delta: Tensor) -> Tensor:
        thickness = _thickness(density, delta)
        after = thickness.cumsum(-1).neg_().exp_()
        opacity = torch.expm1(-thickness).neg_()
        weights = opacity.clone()
        weights[:, 1:] *= after[:, :-1]
        ctx.save_for_backward(delta, after, weights)
        return weights

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        delta, after, weights = ctx.saved_tensors
        product = grad[:, 1:] * weights[:, 1:]  # summed without the own term: nothing cancels on an opaque sample
        behind = torch.nn.functional.pad(product.flip(-1).cumsum(-1).flip(-1), (0, 1))
        return (grad * after - behind) * delta, None


def background_color(name: str, like: Tensor, generator: torch.Generator | None) -> Tensor | None:
    """Colours (R, 3) behind the rays, in the dtype and on the device of `like`; None for `last_sample`."""
    if name == "last_sample":
        return None
    if name == "white":
        return like.new_ones(like.shape[0], 3)
    if name == "black":
        return like.new_zeros(like.shape[0], 3)
    if name != "random":
        raise ValueError(f"background must be one of {', '.join(BACKGROUNDS)}, got {name!r}")
    if generator is None:
        raise ValueError("background=random needs a generator; evaluate on white or black")
    return torch.rand(like.shape[0], 3, dtype=like.dtype, device=generator.device, generator=generator).to(like.device)


def shares(weights: Tensor, background: str) -> Tensor:
    """What each sample's colour counts in its ray's (R, K): its weight; with `last_sample` the last takes the rest."""
    if background != "last_sample":
        return weights
    rest = 1 - weights.sum(-1, keepdim=True).clamp(max=1)
    return torch.cat([weights[:, :-1], weights[:, -1:] + rest], dim=-1)


def render(
    weights: Tensor,
    color: Tensor,
    samples: Samples,
    *,
    background: str,
    parts: Tensor | None = None,
    generator: torch.Generator | None = None,
) -> tuple[Rendering, Tensor | None]:
    """Composites the colours of each ray over a background.

    C = sum_i s_i c_i + (1 - sum_i w_i) c_background. Nothing is clamped: colours in [0, 1] give a colour in [0, 1] up
    to rounding. The expected depth is sum w t / sum w over interval midpoints t; both depths lie between the first and
    the last midpoint, also on empty rays.

    Args:
        weights: (R, K) of `volume_weights`.
        color: (R, M, 3).
        samples: K intervals on each of R rays.
        background: last_sample (the last sample's colour), white, black, or random (a new colour for each ray).
        parts: (R, M) what each colour counts in its ray's, where a gate decided it; None: `shares`, M = K.
        generator: of the random background.

    Returns:
        The rendering, and the colour (R, 3) behind the rays that a target with alpha has to be composited on; None
        for last_sample.

    Raises:
        ValueError: an unknown background, or a random one without a generator.
    """
    accumulation = weights.sum(-1).clamp(max=1)
    behind = background_color(background, weights, generator)
    if parts is None:
        parts = shares(weights, background)
    composite = torch.bmm(parts[:, None], color)[:, 0]
    if behind is not None:
        composite = composite + (1 - accumulation)[:, None] * behind
    with torch.no_grad():
        mids = samples.mids
        half = (weights.cumsum(-1) < 0.5).sum(-1, keepdim=True).clamp_(max=mids.shape[1] - 1)
        median = mids.gather(-1, half)[:, 0]
    depth = (weights * mids).sum(-1) / (weights.sum(-1) + 1e-10)
    depth = torch.minimum(torch.maximum(depth, mids[:, 0]), mids[:, -1])
    return Rendering(composite, depth, median, accumulation, weights), behind
