"""Held-out views of the runs as data URIs, as many as the page may hold."""

import base64
import hashlib
import io
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from PIL import Image

from ..images import Panels, panels, pictures

MOST_VIEWS = 1000
MOST_BYTES = 20 * 2**20
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
    _places: dict[str, int] = field(default_factory=dict)

    @property
    def note(self) -> str:
        """What a reader must know about what is shown, and what is not."""
        parts = ["Difference: the absolute difference of both pictures, times 4. Depth: near is bright."]
        if self.left_out:
            parts.append(f"{self.left_out:,} runs have no pictures here: the page is full at {self.views:,} views.")
        if self.problems:
            parts.append(f"{len(self.problems):,} pictures are damaged, the first {self.problems[0]}.")
        return " ".join(parts)

    def add(self, row: int, view: str, strip: Panels) -> None:
        kinds = {"truth": strip.truth, "render": strip.render, "depth": strip.depth}
        self.runs.setdefault(row, {})[view] = {kind: self._place(pixels) for kind, pixels in kinds.items()}
        self.views += 1

    def _place(self, pixels: np.ndarray) -> int:
        key = hashlib.sha256(pixels.tobytes() + str(pixels.shape).encode()).hexdigest()
        if key not in self._places:
            uri = data_uri(pixels)
            self._places[key] = len(self.files)
            self.files.append({"uri": uri, "width": pixels.shape[1], "height": pixels.shape[0]})
            self.bytes += len(uri)
        return self._places[key]


def gather(
    frame: pd.DataFrame, order: Iterable[int], most: int, *, budget: int = MOST_BYTES, told: Callable[[], None]
) -> Pictures:
    """Views of the runs whose row numbers `order` gives, until there are `most` of them or `budget` bytes are full.

    A run has all its views or none, so that any two of a scene can be compared. `told` is called after each run.
    """
    found = Pictures()
    for row in order:
        stored = pictures(frame["path"].iloc[row])
        if stored and (found.views + len(stored) > most or found.bytes >= budget):
            found.left_out += 1
            stored = {}
        for view, path in stored.items():
            try:
                found.add(row, view, panels(path))
            except ValueError as error:
                found.problems.append(str(error))
        told()
    return found


def data_uri(pixels: np.ndarray) -> str:
    """WebP of (H, W, 3) uint8: exact where it is small, else lossy."""
    data = io.BytesIO()
    exact = pixels.shape[0] * pixels.shape[1] <= SMALL
    Image.fromarray(pixels).save(data, "WEBP", lossless=exact, quality=60 if exact else QUALITY)
    return "data:image/webp;base64," + base64.b64encode(data.getvalue()).decode()
