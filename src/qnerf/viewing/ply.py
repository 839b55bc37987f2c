"""Points as PLY files (Turk 1994), binary, with normals and colours."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from qnerf.records.deletion import refuse_runs
from qnerf.records.files import replace, reporting

_VERTEX = np.dtype([(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [(c, "u1") for c in "rgb"])


@dataclass(frozen=True)
class Points:
    """N points of a surface."""

    points: NDArray  # (N, 3)
    normals: NDArray  # (N, 3) unit length, towards empty space
    colors: NDArray  # (N, 3) uint8

    def moved(self, similarity: NDArray) -> "Points":
        """The points after a similarity (4, 4) that does not mirror."""
        linear = similarity[:3, :3]
        points = self.points @ linear.T + similarity[:3, 3]
        return Points(points, self.normals @ linear.T / np.cbrt(np.linalg.det(linear)), self.colors)


def encode(cloud: Points) -> bytes:
    """A PLY file: x y z nx ny nz as float, red green blue as uchar."""
    rows = np.empty(len(cloud.points), _VERTEX)
    for names, values in (("xyz", cloud.points), (("nx", "ny", "nz"), cloud.normals), ("rgb", cloud.colors)):
        for column, name in enumerate(names):
            rows[name] = values[:, column]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    return "\n".join([*header, "end_header", ""]).encode() + rows.tobytes()


def write(file: Path, cloud: Points) -> None:
    """Replaces the file whole. ValueError if it cannot be written, or would lie in a run's folder."""
    refuse_runs(file.parent)
    with reporting(file):
        file.parent.mkdir(parents=True, exist_ok=True)
    replace(file, encode(cloud))
