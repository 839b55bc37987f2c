"""Textures of the built-in room, procedural and photographed: linear albedo (h, w, 3) float32."""

from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from PIL import Image

Picture: TypeAlias = NDArray[np.float32]


def linear(srgb: NDArray) -> Picture:
    """sRGB-encoded values in [0, 1] -> linear light in [0, 1]."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4).astype(np.float32)


def encoded(light: NDArray) -> NDArray:
    """Linear light, clipped to [0, 1] -> sRGB-encoded values."""
    light = np.clip(light, 0, 1)
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)


def rgb(text: str) -> Picture:
    """Six hexadecimal digits of an sRGB colour -> linear (3,)."""
    return linear(np.array([int(text[i : i + 2], 16) for i in (0, 2, 4)]) / 255)


@cache
def photograph(name: str) -> Picture:
    """A photograph that scikit-image's package contains: nothing is downloaded."""
    with Image.open(str(files("skimage.data").joinpath(f"{name}.png"))) as image:
        return linear(np.asarray(image.convert("RGB")) / 255)


def resized(picture: Picture, height: int, width: int) -> Picture:
    """The picture sampled bilinearly at `height` x `width` texel centres."""
    for axis, size in ((0, height), (1, width)):
        position = (np.arange(size) + 0.5) * picture.shape[axis] / size - 0.5
        low = np.clip(np.floor(position).astype(int), 0, picture.shape[axis] - 1)
        high = np.minimum(low + 1, picture.shape[axis] - 1)
        shape = [1, 1, 1]
        shape[axis] = size
        fraction = np.clip(position - low, 0, 1).astype(np.float32).reshape(shape)
        picture = np.take(picture, low, axis) * (1 - fraction) + np.take(picture, high, axis) * fraction
    return picture


def grid(height: int, width: int, size: Sequence[float]) -> tuple[NDArray, NDArray]:
    """Texel centres of a face of `size` (width, height): x (1, w) to the right and y (h, 1) down, in metres."""
    x = (np.arange(width, dtype=np.float32) + np.float32(0.5)) * np.float32(size[0] / width)
    y = (np.arange(height, dtype=np.float32) + np.float32(0.5)) * np.float32(size[1] / height)
    return x[None, :], y[:, None]


def noise(x: NDArray, y: NDArray, seed: int, octaves: int = 1) -> NDArray:
    """Smooth value noise (h, w) in [0, 1] at x (1, w) and y (h, 1), with one lattice cell per unit.

    Each octave doubles the frequency and halves the amplitude.
    """
    total = np.zeros((y.size, x.size), np.float32)
    for octave in range(octaves):
        lattice = np.random.default_rng([seed, octave]).random((256, 256), np.float32)
        i, s = _lattice(x.reshape(-1) * 2**octave)
        j, t = _lattice(y.reshape(-1) * 2**octave)
        rows = lattice[:, i] * (1 - s) + lattice[:, (i + 1) % 256] * s
        low = rows[j]
        total += (low + (rows[(j + 1) % 256] - low) * t[:, None]) * np.float32(0.5**octave)
    return total / np.float32(2 - 0.5 ** (octaves - 1))


def _lattice(position: NDArray) -> tuple[NDArray, NDArray]:
    """Lattice index and smoothed fraction of each coordinate."""
    index = np.floor(position)
    fraction = (position - index).astype(np.float32)
    return index.astype(np.int64) % 256, fraction * fraction * (3 - 2 * fraction)


def chance(i: NDArray, j: NDArray, seed: int) -> NDArray:
    """A random number in [0, 1) for each cell (i, j)."""
    return np.random.default_rng(seed).random((64, 64), np.float32)[j.astype(int) % 64, i.astype(int) % 64]


def edge(distance: NDArray, width: float) -> NDArray:
    """A smooth step from 0 at distance 0 to 1 at `width`."""
    s = np.clip(distance / width, 0, 1)
    return s * s * (3 - 2 * s)


def mix(a: NDArray, b: NDArray, share: NDArray) -> NDArray:
    """Mixes colours (3,) or (h, w, 3): a where `share` (h, w) is 0, b where it is 1."""
    return a + (b - a) * share[..., None]


def paint(color: str, height: int, width: int, size: Sequence[float], seed: int) -> Picture:
    """Wall paint with faint blotches."""
    x, y = grid(height, width, size)
    return (rgb(color) * (0.9 + 0.2 * noise(x * 3, y * 3, seed, 3))[..., None]).astype(np.float32)


def bricks(height: int, width: int, size: Sequence[float]) -> Picture:
    """A brick wall; `size` in metres, as in all of these."""
    x, y = grid(height, width, size)
    row = np.floor(y / 0.085)
    shifted = x + 0.13 * (row % 2)
    column = np.floor(shifted / 0.26)
    u, v = shifted - column * 0.26, y - row * 0.085
    inset = np.minimum(np.minimum(u, 0.26 - u), np.minimum(v, 0.085 - v)) + 0.004 * (noise(x * 60, y * 60, 11) - 0.5)
    body = mix(rgb("8f4a38"), rgb("c98a6b"), chance(column, row, 12))
    body = mix(body, rgb("5d3a35"), edge(chance(column, row, 13) - 0.8, 0.1) * 0.7)
    body *= (0.7 + 0.6 * noise(x * 70, y * 70, 14, 3))[..., None]
    mortar = rgb("bdb3a4") * (0.8 + 0.4 * noise(x * 90, y * 90, 15))[..., None]
    return mix(mortar, body, edge(inset - 0.006, 0.006)).astype(np.float32)


def planks(height: int, width: int, size: Sequence[float], dark: str, light: str, seed: int, board: float) -> Picture:
    """Wooden boards, `board` metres wide, that run to the right; the grain is noise stretched along them."""
    x, y = grid(height, width, size)
    row = np.floor(y / board)
    length = board * 7
    shifted = x + length * chance(row, row, seed)
    column = np.floor(shifted / length)
    u, v = shifted - column * length, y - row * board
    tone = chance(column, row, seed + 1)
    warp = noise(x * 2, y * 9 + 31 * row, seed + 2, 2)
    rings = 0.5 + 0.5 * np.sin(np.float32(2 * np.pi) * (warp * 9 + y * 22))
    fibre = noise(x * 9, y * 260 + 31 * row, seed + 3, 2)
    share = np.clip(0.15 + 0.45 * tone + 0.25 * (rings - 0.5) + 0.5 * (fibre - 0.5), 0, 1)
    gap = edge(np.minimum(np.minimum(u, length - u), np.minimum(v, board - v)), 0.006)
    return (mix(rgb(dark), rgb(light), share) * (0.25 + 0.75 * gap)[..., None]).astype(np.float32)


def wallpaper(height: int, width: int, size: Sequence[float]) -> Picture:
    """Striped wallpaper with lozenges, above a white skirting board."""
    x, y = grid(height, width, size)
    stripe = 0.5 + 0.5 * np.tanh(6 * np.sin(2 * np.pi * x / 0.36))
    picture = mix(rgb("8fb0ae"), rgb("b9cfc6"), stripe)
    u, v = (x + 0.09) % 0.36 - 0.18, (y + 0.11) % 0.22 - 0.11
    lozenge = edge(0.075 - np.abs(u) * 1.4 - np.abs(v), 0.012) * (1 - edge(0.045 - np.abs(u) * 1.4 - np.abs(v), 0.012))
    picture = mix(picture, rgb("e9e2c8"), lozenge)
    u = x % 0.36 - 0.18 + 0.09
    dots = edge(0.022 - np.hypot(u, v), 0.008)
    picture = mix(picture, rgb("3f6f7a"), dots) * (0.88 + 0.24 * noise(x * 12, y * 12, 21, 3))[..., None]
    skirting = size[1] - y
    board = rgb("efece4") * (0.6 + 0.4 * edge(np.abs(skirting - 0.075), 0.006))[..., None]
    return mix(picture, board, edge(0.1 - skirting, 0.004)).astype(np.float32)


def rug(floor: Picture, size: Sequence[float], centre: Sequence[float], half: Sequence[float]) -> Picture:
    """The floor with a woven rug on it: zigzag bands in four colours and a border."""
    x, y = grid(floor.shape[0], floor.shape[1], size)
    u, v = x - centre[0], y - centre[1]
    zigzag = v + 0.05 * np.abs((u / 0.12) % 2 - 1)
    band = np.floor(zigzag / 0.06) % 4
    colors = np.stack([rgb(color) for color in ("b5463b", "ece3cf", "27476e", "d9a441")])
    weave = 0.75 + 0.5 * noise(x * 150, y * 150, 31)
    inside = np.minimum(half[0] - np.abs(u), half[1] - np.abs(v))
    pattern = mix(colors[band.astype(int)], rgb("27313f"), 1 - edge(inside - 0.05, 0.01)) * weave[..., None]
    return mix(floor, pattern, edge(inside, 0.006)).astype(np.float32)


def framed(picture: Picture, height: int, width: int, size: Sequence[float], wood: str, mat: float) -> Picture:
    """A picture behind a mat, in a wooden frame 4 cm wide."""
    x, y = grid(height, width, size)
    border = np.minimum(np.minimum(x, size[0] - x), np.minimum(y, size[1] - y))
    margin = 0.04 + mat
    rows = np.flatnonzero((y > margin) & (y < size[1] - margin))
    columns = np.flatnonzero((x > margin) & (x < size[0] - margin))
    result = np.broadcast_to(rgb("f1efe8"), (height, width, 3)).astype(np.float32)
    result[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] = resized(picture, len(rows), len(columns))
    grain = 0.7 + 0.6 * noise(x * 25, y * 25, 41, 3)
    return mix(rgb(wood) * grain[..., None], result, edge(border - 0.038, 0.004)).astype(np.float32)


def checker(height: int, width: int, cells: int, a: str, b: str) -> Picture:
    """A checkerboard of cells x cells in two colours."""
    x, y = grid(height, width, (cells, cells))
    share = 0.5 + 0.5 * np.tanh(12 * np.sin(np.pi * x) * np.sin(np.pi * y))
    return mix(rgb(a), rgb(b), share).astype(np.float32)


def stripes(height: int, width: int, bands: float, colors: Sequence[str], slant: float = 0.0) -> Picture:
    """Bands of colour from top to bottom, shifted by `slant` bands from left to right."""
    x, y = grid(height, width, (1, 1))
    position = y * bands + x * slant
    band, fraction = np.floor(position).astype(int), position % 1
    table = np.stack([rgb(color) for color in colors])
    blend = edge(fraction - 0.94, 0.06)
    return mix(table[band % len(colors)], table[(band + 1) % len(colors)], blend).astype(np.float32)


def drawers(height: int, width: int, size: Sequence[float], across: int, down: int) -> Picture:
    """The front of a sideboard: walnut, drawers with gaps and round knobs."""
    x, y = grid(height, width, size)
    wood = planks(height, width, size, "4a2f20", "8a5f3f", 51, size[1] / down)
    w, h = size[0] / across, size[1] / down
    u, v = x % w, y % h
    gap = edge(np.minimum(np.minimum(u, w - u), np.minimum(v, h - v)) - 0.004, 0.006)
    knob = edge(0.022 - np.hypot(u - w / 2, v - h / 2), 0.006)
    return mix(wood * (0.2 + 0.8 * gap)[..., None], rgb("e4c98c"), knob).astype(np.float32)


def shelves(height: int, width: int, size: Sequence[float]) -> Picture:
    """A wall of books, visible only in reflections."""
    x, y = grid(height, width, size)
    row, column = np.floor(y / 0.33), np.floor(x / 0.05)
    palette = np.stack([rgb(color) for color in ("7a2e2e", "2e4d6b", "d8c9a3", "4d6b3c", "c27b3a", "2b2b33")])
    spines = palette[(chance(column, row, 61) * len(palette)).astype(int)]
    tall = 0.2 + 0.1 * chance(column, row, 62)
    book = edge(0.33 - (y - row * 0.33) - 0.03, 0.01) * edge(tall - (0.33 - (y - row * 0.33)), 0.01)
    return mix(rgb("5a4433"), spines, book).astype(np.float32)


def panes(height: int, width: int, across: int, down: int) -> Picture:
    """A window: white panes, dark bars between them."""
    x, y = grid(height, width, (across, down))
    u, v = x % 1, y % 1
    glass = edge(np.minimum(np.minimum(u, 1 - u), np.minimum(v, 1 - v)) - 0.05, 0.02)
    return mix(rgb("3a3a3a"), np.ones(3), glass).astype(np.float32)


def plain(color: str) -> Picture:
    """One colour."""
    return np.broadcast_to(rgb(color), (4, 4, 3)).astype(np.float32)
