"""The area filter: a reduced image's pixels are means over the areas that they cover."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array


def area_downscale(image: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Means over blocks of `factor` x `factor` pixels, rounded half up. A remainder at the right and bottom is dropped.

    The means are of the sRGB-encoded values. Colours are weighted by alpha.

    >>> area_downscale(np.array([[[1, 1, 1], [2, 2, 2]], [[2, 2, 2], [2, 2, 2]]], np.uint8), 2).tolist()
    [[[2, 2, 2]]]
    """
    if factor == 1:
        return image
    height, width = image.shape[0] // factor, image.shape[1] // factor
    blocks = image[: height * factor, : width * factor].reshape(height, factor, width, factor, -1)
    area = factor * factor
    sums = blocks.sum(axis=(1, 3), dtype=np.int64)
    if blocks.shape[-1] == 3:
        return ((2 * sums + area) // (2 * area)).astype(np.uint8)
    weight = sums[..., 3:]
    weighted = blocks[..., :3].astype(np.uint16) * blocks[..., 3:]  # 255^2 fits
    colors = weighted.sum(axis=(1, 3), dtype=np.int64)
    safe = np.maximum(weight, 1)
    mean = np.concatenate([(2 * colors + safe) // (2 * safe), (2 * weight + area) // (2 * area)], axis=-1)
    return mean.astype(np.uint8)


def area_resize(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """Reduces an image (H, W, 3 or 4): each new pixel is the mean over its area, rounded half up, as in
    `area_downscale`, by which whole factors are reduced.

    >>> area_resize(np.array([[[0] * 3, [90] * 3, [255] * 3]], np.uint8), 2, 1)[..., 0].tolist()
    [[30, 200]]
    """
    rows, columns = image.shape[:2]
    if (columns, rows) == (width, height):
        return image
    if columns % width == rows % height == 0 and columns // width == rows // height:
        return area_downscale(image, rows // height)
    values = image.astype(np.float32)
    if image.shape[2] == 4:
        values[..., :3] *= values[..., 3:]
    values = area_means(values, width, height)
    if image.shape[2] == 4:
        values[..., :3] /= np.maximum(values[..., 3:], 1e-6)
    return np.floor(values + np.float32(0.5)).clip(0, 255).astype(np.uint8)


def area_means(values: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """(H, W, C) -> (height, width, C): each new pixel is the mean over its area."""
    rows, columns, channels = values.shape
    values = _shares(rows, height) @ values.reshape(rows, -1)
    values = values.reshape(height, columns, channels).transpose(1, 0, 2).reshape(columns, -1)
    return (_shares(columns, width) @ values).reshape(width, height, channels).transpose(1, 0, 2)


def _shares(old: int, new: int) -> csr_array:
    """(new, old): the share of each old cell in each new one, where `old` cells are divided into `new` ones."""
    edges = np.union1d(np.arange(new + 1) * old, np.arange(old + 1) * new)  # in units of 1 / (old * new) of the whole
    lengths = (np.diff(edges) / old).astype(np.float32)
    return csr_array((lengths, (edges[:-1] // old, edges[:-1] // new)), shape=(new, old))
