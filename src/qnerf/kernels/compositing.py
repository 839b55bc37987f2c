"""Colours on rays -> the squared errors of their pixels, with the gradients: a compiled CPU loop.

The plain PyTorch reference is `qnerf.rendering.render.render` with `qnerf.training.losses.mse`.
"""

import numpy as np

from qnerf.kernels.hashgrid import U
from qnerf.kernels.jit import jit

GRAIN = 256  # rays that are worth waking a thread for


@jit
def composite(  # type: ignore[no-untyped-def]
    start, stop, points, count, shares, weights, chosen, ends, pixels, behind, losses, to_colors, to_shares, to_weights,
    colors,
):  # fmt: skip
    """Writes the squared errors of rays start..stop, summed over channels, and the gradients of the mean over all.

    `colors` (N, 3) are those of the `chosen` points (R, M); `ends` (R,) counts them up to the end of each ray. `pixels`
    (R, 3 or 4) are the true colours, and `behind` (R, 3) the background, or empty.
    """
    number = colors.dtype.type
    zero, one, two = number(0), number(1), number(2)
    m, n, three = U(points), U(count), U(3)
    channels = U(pixels.size // losses.size)
    scale = two / number(3 * losses.size)
    error = np.empty(3, colors.dtype)
    for ray in range(U(start), U(stop)):
        first = U(ends[ray - U(1)]) if ray else U(0)
        # The rendered pixel: the colours of the ray by their shares, and the background by the light that is left.
        error[:] = zero
        row = first
        for i in range(ray * m, (ray + U(1)) * m):
            for c in range(three):
                error[c] += shares[i] * (colors[three * row + c] if chosen[i] else zero)  # a share that is NaN stays
            row += U(chosen[i])
        opacity = zero
        for i in range(ray * n, (ray + U(1)) * n):
            opacity += weights[i]
        left = zero if opacity > one else one - opacity
        if behind.size:
            for c in range(three):
                error[c] += left * behind[three * ray + c]
        # What it is off by. A true colour with alpha lies over the same background.
        total = 0.0
        for c in range(three):
            true = pixels[channels * ray + c]
            if channels > three:
                alpha = pixels[channels * ray + three]
                true = true * alpha + behind[three * ray + c] * (one - alpha)
            error[c] -= true
            total += np.float64(error[c]) * error[c]
            error[c] *= scale
        losses[ray] = total
        # `error` is now the gradient of the pixel: from it those of each colour, of its share, and of the weights,
        # which take light from the background unless they sum to more than 1 by rounding.
        row = first
        for i in range(ray * m, (ray + U(1)) * m):
            to_shares[i] = zero
            if chosen[i]:
                for c in range(three):
                    to_colors[three * row + c] = shares[i] * error[c]
                    to_shares[i] += colors[three * row + c] * error[c]
                row += U(1)
        to_opacity = zero
        if behind.size and not opacity > one:
            for c in range(three):
                to_opacity -= behind[three * ray + c] * error[c]
        for i in range(ray * n, (ray + U(1)) * n):
            to_weights[i] = to_opacity
