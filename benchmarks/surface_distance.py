"""How far an exported surface of the built-in scene is from the room itself.

    qnerf export RUN --to mesh
    python -m benchmarks.surface_distance exports/mesh/RUN.ply

It prints the mean, the median and the 90th percentile of the distance from the file's points to the nearest surface of
the room, in metres. The room measures 3.9 x 4.0 x 2.6 metres.
"""

import argparse
from pathlib import Path

import numpy as np

from qnerf.scenes.builtin.room import room
from qnerf.viewing.ply import Surface, decode


def distances(surface: Surface) -> np.ndarray:
    """Metres (N,) between the points and the room's nearest surface."""
    return np.abs(room().clearance(surface.points.T.astype(np.float64)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="PLY files of qnerf export")
    for file in parser.parse_args().files:
        apart = distances(decode(file.read_bytes()))
        numbers = (
            f"mean {apart.mean():.3f} m, median {np.median(apart):.3f} m, 90 % within {np.percentile(apart, 90):.3f} m"
        )
        print(f"{file.name}: {len(apart):,} points, {numbers}")


if __name__ == "__main__":
    main()
