"""Points and meshes as PLY files (Turk 1994), binary, with normals and colours."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from qnerf.records.deletion import refuse_runs
from qnerf.records.files import replace, reporting

_VERTEX = np.dtype([(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [(c, "u1") for c in "rgb"])
_FACE = np.dtype([("count", "u1"), ("corners", "<i4", (3,))])


@dataclass(frozen=True)
class Surface:
    """N points of a surface, and the F triangles between them, if any."""

    points: NDArray  # (N, 3)
    normals: NDArray  # (N, 3) unit length, towards empty space
    colors: NDArray  # (N, 3) uint8
    faces: NDArray | None = None  # (F, 3) indices of points, counterclockwise seen from empty space

    def moved(self, similarity: NDArray) -> "Surface":
        """The surface after a similarity (4, 4) that does not mirror."""
        linear = similarity[:3, :3]
        points = self.points @ linear.T + similarity[:3, 3]
        return Surface(points, self.normals @ linear.T / np.cbrt(np.linalg.det(linear)), self.colors, self.faces)


def encode(surface: Surface) -> bytes:
    """A PLY file: x y z nx ny nz as float, red green blue as uchar, and the triangles."""
    rows = np.empty(len(surface.points), _VERTEX)
    for names, values in (("xyz", surface.points), (("nx", "ny", "nz"), surface.normals), ("rgb", surface.colors)):
        for column, name in enumerate(names):
            rows[name] = values[:, column]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    data = rows.tobytes()
    if surface.faces is not None:
        triangles = np.empty(len(surface.faces), _FACE)
        triangles["count"], triangles["corners"] = 3, surface.faces
        header += [f"element face {len(triangles)}", "property list uchar int vertex_indices"]
        data += triangles.tobytes()
    return "\n".join([*header, "end_header", ""]).encode() + data


def write(file: Path, surface: Surface) -> None:
    """Replaces the file whole. ValueError if it cannot be written, or would lie in a run's folder."""
    refuse_runs(file.parent)
    with reporting(file):
        file.parent.mkdir(parents=True, exist_ok=True)
    replace(file, encode(surface))
