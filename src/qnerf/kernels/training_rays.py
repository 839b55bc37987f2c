"""Numbers of training pixels -> their rays and colours: a compiled CPU loop.

The plain PyTorch reference is in `qnerf.geometry.rays.RayTable`.
"""

import numpy as np

from qnerf.kernels.hashgrid import U
from qnerf.kernels.jit import jit

GRAIN = 1024  # rays that are worth waking a thread for


@jit
def gather_rays(  # type: ignore[no-untyped-def]
    start, stop, numbers, ends, views_of, unmasked, first_pixel, lens_of, first_direction, in_camera, poses, pixels,
    origins, directions, colors, views,
):  # fmt: skip
    """Writes the origins, directions, colours and views of pixels start..stop of a batch."""
    number = poses.dtype.type
    channels = U(colors.size // numbers.size)
    for i in range(U(start), U(stop)):
        # Pixels are numbered view by view: the view is the first one whose numbers end behind this one.
        low, high = 0, ends.size
        while low < high:
            middle = (low + high) // 2
            if ends[middle] > numbers[i]:
                high = middle
            else:
                low = middle + 1
        before = ends[low - 1] if low else 0
        view = views_of[low]
        pixel = np.int64(unmasked[numbers[i]]) if unmasked.size else numbers[i] - before
        views[i] = view
        # The direction in the camera's frame, turned by the pose (3, 4), whose last column is the origin.
        j, r, p = U(3) * i, U(3) * U(first_direction[lens_of[view]] + pixel), U(12) * U(view)
        x, y, z = in_camera[r], in_camera[r + U(1)], in_camera[r + U(2)]
        for axis in range(U(3)):
            row = p + U(4) * axis
            directions[j + axis] = poses[row] * x + poses[row + U(1)] * y + poses[row + U(2)] * z
            origins[j + axis] = poses[row + U(3)]
        for channel in range(channels):
            colors[i * channels + channel] = number(pixels[U(first_pixel[view] + pixel) * channels + channel]) / number(
                255
            )
