"""Held-out views of the runs as data URIs, up to the limit of the page."""

import base64
import hashlib
import io
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from PIL import Image

from ..images import panels, pictures

MAX_VIEWS = 1000
MAX_BYTES = 20 * 2**20
SMALL = 128 * 128  # pixels up to which a picture is kept exactly
QUALITY = 88


@dataclass
class Pictures:
    """files: the pictures, each once, with width and height in pixels; runs: row -> view -> kind -> its place there."""

    files: list[dict[str, Any]] = field(default_factory=list)
    runs: dict[int, dict[str, dict[str, int]]] = field(default_factory=dict)
    views: int = 0
    bytes: int = 0
    left_out: int = 0
    problems: list[str] = field(default_factory=list)
    _indices: dict[str, int] = field(default_factory=dict)

    @property
    def note(self) -> str:
        """Which pictures are missing."""
        parts = []
        if self.left_out:
            parts.append(f"{self.left_out:,} runs have no pictures here: the page is full at {self.views:,} views.")
        if self.problems:
            parts.append(f"{len(self.problems):,} pictures are damaged, the first {self.problems[0]}.")
        return " ".join(parts)

    def add(self, row: int, view: str, panels: Mapping[str, np.ndarray]) -> None:
        """All panels but the error, which the page makes from two of them."""
        kept = {name: self._index(pixels) for name, pixels in panels.items() if name != "error"}
        self.runs.setdefault(row, {})[view] = kept
        self.views += 1

    def _index(self, pixels: np.ndarray) -> int:
        key = hashlib.sha256(pixels.tobytes() + str(pixels.shape).encode()).hexdigest()
        if key not in self._indices:
            uri = data_uri(pixels)
            self._indices[key] = len(self.files)
            self.files.append({"uri": uri, "width": pixels.shape[1], "height": pixels.shape[0]})
            self.bytes += len(uri)
        return self._indices[key]


def gather(frame: pd.DataFrame, order: Iterable[int], max_views: int, *, budget: int = MAX_BYTES) -> Pictures:
    """Views of the runs with the row numbers `order`, until there are `max_views` of them or `budget` bytes.

    A run has all its views or none, so that any two of a scene can be compared.
    """
    result = Pictures()
    for row in order:
        stored, signal = pictures(frame["path"].iloc[row]), pd.notna(frame["head"].iloc[row])
        if stored and (result.views + len(stored) > max_views or result.bytes >= budget):
            result.left_out += 1
            stored = {}
        for view, path in stored.items():
            try:
                result.add(row, view, panels(path, signal=signal))
            except ValueError as error:
                result.problems.append(str(error))
    return result


def data_uri(pixels: np.ndarray) -> str:
    """WebP of (H, W, 3) uint8: exact where it is small, else lossy."""
    data = io.BytesIO()
    exact = pixels.shape[0] * pixels.shape[1] <= SMALL
    Image.fromarray(pixels).save(data, "WEBP", lossless=exact, quality=60 if exact else QUALITY)
    return "data:image/webp;base64," + base64.b64encode(data.getvalue()).decode()
