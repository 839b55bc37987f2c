"""Volume rendering: densities and colours of samples -> colour, depth and opacity of rays.

sigma is an interval's density per world unit, delta its length, T the transmittance up to it (Sec. 4,
arXiv:2003.08934).
"""

import torch
from torch import Tensor

from qnerf.config.tensors import require_tensor
from qnerf.kernels import transmittance
from qnerf.kernels.derivatives import clamped
from qnerf.kernels.loop import Loop
from qnerf.rendering.background import background_color
from qnerf.types import Rendering, Samples


def volume_weights(density: Tensor, delta: Tensor) -> Tensor:
    """Weights of the intervals: w_i = T_i (1 - e^(-sigma_i delta_i)), T_i = exp(-sum_{j<i} sigma_j delta_j).

    The weights of a ray sum to its opacity, 1 - T(end): at most 1 up to K roundings. Any density from 0 to infinity
    gives finite weights and gradients. An interval of length 0 has weight 0. A NaN density gives NaN.

    >>> weights = volume_weights(torch.tensor([[0.0, 0.6931472, 100.0]]), torch.ones(1, 3))
    >>> [round(w, 4) for w in weights[0].tolist()]  # empty; half opaque; takes the remaining half
    [0.0, 0.5, 0.5]

    Args:
        density: (R, K) per world unit, >= 0.
        delta: (R, K) world units, >= 0. No gradient flows to it.

    Returns:
        (R, K) in [0, 1].
    """
    require_tensor("volume_weights: delta", delta, density.shape)
    weights: Tensor = _VOLUME_WEIGHTS(density, delta)
    return weights


def volume_weights_reference(density: Tensor, delta: Tensor) -> Tensor:
    """`volume_weights` in plain PyTorch, differentiated by autograd."""
    thickness = density.clamp(max=torch.finfo(density.dtype).max) * delta.detach()  # infinity times 0 is 0
    before = torch.nn.functional.pad(thickness.cumsum(-1)[:, :-1], (1, 0))
    # Autograd computes the derivative of expm1 from its value, which loses its digits where the value is nearly -1.
    opacity = torch.where(thickness < 1, -torch.expm1(-thickness), 1 - torch.exp(-thickness))
    return opacity * torch.exp(-before)


_VOLUME_WEIGHTS = Loop(
    "volume weights",
    volume_weights_reference,
    transmittance.volume_weights,
    transmittance.volume_weights_gradient,
)


def color_shares(weights: Tensor, background: str) -> Tensor:
    """Share of each sample's colour in its ray's (R, K): the weights (R, K), and with `last_sample` the last sample
    also takes the transmittance that is left.

    >>> color_shares(torch.tensor([[0.25, 0.25]]), "last_sample").tolist()
    [[0.25, 0.75]]
    """
    if background != "last_sample":
        return weights
    rest = 1 - clamped(weights.sum(-1, keepdim=True), high=1.0)
    return torch.cat([weights[:, :-1], weights[:, -1:] + rest], dim=-1)


def render(
    weights: Tensor,
    color: Tensor,
    samples: Samples,
    *,
    background: str,
    shares: Tensor | None = None,
    generator: torch.Generator | None = None,
) -> tuple[Rendering, Tensor | None]:
    """Composites the colours along each ray over a background: C = sum_i s_i c_i + (1 - sum_i w_i) c_background.

    Nothing is clamped: colours in [0, 1] give a colour in [0, 1] up to rounding.

    Args:
        weights: (R, K) of `volume_weights`.
        color: (R, M, 3).
        samples: K intervals on each of R rays.
        background: last_sample (the last sample's colour), white, black, or random (a new colour for each ray).
        shares: (R, M) of each colour in its ray's colour, where shading chose M colours; None: `color_shares`, M = K.
        generator: of the random background.

    Returns:
        The rendering, and the background colours (R, 3), on which a target with alpha must be composited; None for
        last_sample.

    Raises:
        ValueError: an unknown background, or a random one without a generator.
    """
    accumulation = clamped(weights.sum(-1), high=1.0)
    behind = background_color(background, weights, generator)
    if shares is None:
        shares = color_shares(weights, background)
    pixel = torch.bmm(shares[:, None], color)[:, 0]
    if behind is not None:
        pixel = pixel + (1 - accumulation)[:, None] * behind
    return Rendering(pixel, accumulation, weights, samples), behind
