"""Mipmapped textures in one array, sampled by many rays at once."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from qnerf.scenes.builtin.textures import Picture


@dataclass
class Atlas:
    """Collects textures and their mipmaps. `packed` makes them ready to sample."""

    texels: list[Picture] = field(default_factory=list)
    offsets: list[list[int]] = field(default_factory=list)
    shapes: list[list[tuple[int, int]]] = field(default_factory=list)
    total: int = 0

    def add(self, picture: Picture) -> int:
        """Adds a picture (h, w, 3) and its successive half-size copies; returns the texture's number."""
        offsets, shapes = [], []
        level = np.asarray(picture, np.float32)
        while True:
            height, width = level.shape[:2]
            offsets.append(self.total)
            shapes.append((height, width))
            self.texels.append(level.reshape(-1, 3))
            self.total += height * width
            if min(height, width) < 2 or height % 2 or width % 2:
                break
            level = (level[0::2, 0::2] + level[1::2, 0::2] + level[0::2, 1::2] + level[1::2, 1::2]) * np.float32(0.25)
        self.offsets.append(offsets)
        self.shapes.append(shapes)
        return len(self.offsets) - 1

    def packed(self) -> "PackedAtlas":
        levels = max(map(len, self.offsets))
        offset, height, width = (np.zeros((len(self.offsets), levels), np.int32) for _ in range(3))
        for index, (offsets, shapes) in enumerate(zip(self.offsets, self.shapes, strict=True)):
            for level in range(levels):  # beyond its coarsest level, a texture repeats it
                at = min(level, len(offsets) - 1)
                offset[index, level] = offsets[at]
                height[index, level], width[index, level] = shapes[at]
        return PackedAtlas(np.concatenate(self.texels), offset, height, width)


@dataclass(frozen=True)
class PackedAtlas:
    """Mipmapped textures in one array; offset, height and width are (textures, levels)."""

    texels: NDArray  # (texels, 3)
    offset: NDArray
    height: NDArray
    width: NDArray

    def sample(self, texture: NDArray, u: NDArray, v: NDArray, level: NDArray) -> NDArray:
        """Colours (M, 3) of textures (M,) at u (right) and v (down) in [0, 1], at fractional mipmap levels (M,)."""
        level = np.clip(level, 0, self.offset.shape[1] - 1)
        low = level.astype(np.int32)
        fraction = (level - low).astype(np.float32)[:, None]
        high = np.minimum(low + 1, self.offset.shape[1] - 1)
        return self._bilinear(texture, u, v, low) * (1 - fraction) + self._bilinear(texture, u, v, high) * fraction

    def _bilinear(self, texture: NDArray, u: NDArray, v: NDArray, level: NDArray) -> NDArray:
        offset, height, width = self.offset[texture, level], self.height[texture, level], self.width[texture, level]
        return bilinear(self.texels, offset, height, width, u, v)


def bilinear(texels: NDArray, offset: NDArray, height: NDArray, width: NDArray, u: NDArray, v: NDArray) -> NDArray:
    """Bilinear samples (M, C) of pictures that begin at texels[offset], clamped at the borders."""
    x = np.clip(u * width - np.float32(0.5), 0, width - 1).astype(np.float32)
    y = np.clip(v * height - np.float32(0.5), 0, height - 1).astype(np.float32)
    x0, y0 = x.astype(np.int32), y.astype(np.int32)
    right = np.minimum(x0 + 1, width - 1) - x0
    below = np.where(y0 + 1 < height, width, 0).astype(np.int32)
    s, t = (x - x0)[:, None], (y - y0)[:, None]
    at = offset + y0 * width + x0
    top = np.take(texels, at, 0) * (1 - s) + np.take(texels, at + right, 0) * s
    at = at + below
    return top * (1 - t) + (np.take(texels, at, 0) * (1 - s) + np.take(texels, at + right, 0) * s) * t
