"""How well `qnerf capture` finds poses that are known: `python -m benchmarks.capture_poses poster --views 60`.

Writes the images of a scene to a folder, gives `qnerf capture` no poses, moves the poses that it finds by the
similarity that brings their camera centres closest to the true ones, and prints what is left: degrees between
rotations, and distances between centres in per cent of the cameras' extent.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from qnerf.capture.photographs import capture
from qnerf.scenes import SCENES, Scene


def aligned(found: NDArray, true: NDArray) -> NDArray:
    """Poses (V, 3, 4) after the similarity whose centres are closest to those of `true` (Umeyama 1991)."""
    a, b = found[:, :, 3], true[:, :, 3]
    centred, target = a - a.mean(axis=0), b - b.mean(axis=0)
    left, sizes, right = np.linalg.svd(target.T @ centred)
    signs = np.array([1.0, 1.0, np.linalg.det(left @ right)])
    turn = (left * signs) @ right
    scale = (sizes * signs).sum() / (centred**2).sum()
    return np.concatenate([turn @ found[:, :, :3], (scale * centred @ turn.T + b.mean(axis=0))[..., None]], axis=2)


def errors(found: NDArray, true: NDArray) -> tuple[NDArray, NDArray]:
    """Degrees between rotations, and distances of centres in per cent of the extent of the true ones, of V poses."""
    moved = aligned(found, true)
    cosines = (np.einsum("vij,vij->v", moved[:, :, :3], true[:, :, :3]) - 1) / 2
    extent = np.ptp(true[:, :, 3], axis=0).max()
    apart = np.linalg.norm(moved[:, :, 3] - true[:, :, 3], axis=1)
    return np.degrees(np.arccos(np.clip(cosines, -1, 1))), 100 * apart / extent


def report(scene: Scene) -> str:
    with tempfile.TemporaryDirectory() as folder:
        photographs, out = Path(folder, "photographs"), Path(folder, "scene")
        photographs.mkdir()
        for view, image in enumerate(scene.images):
            Image.fromarray(image[..., :3].numpy()).save(photographs / f"{view:04}.png")
        start = time.monotonic()
        posed = capture(photographs, out).posed
        seconds = time.monotonic() - start
        found = SCENES.build("nerfstudio", path=str(out)).cameras.poses.numpy()
    true = scene.cameras.poses.numpy()[[int(name.partition(".")[0]) for name in posed]]
    turns, moves = errors(found, true)
    return (
        f"{len(posed)} of {len(scene.images)} posed in {seconds:.0f} s; "
        f"rotations off by {np.median(turns):.2f} degrees in the median, {turns.max():.2f} at most; "
        f"centres by {np.median(moves):.2f} % of the cameras' extent, {moves.max():.2f} % at most"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", help="poster, or a folder that scene=nerfstudio reads")
    parser.add_argument("--views", type=int, default=60, help="poster: number of photographs (default: %(default)s)")
    parser.add_argument("--width", type=int, default=360, help="poster: pixels; 16/9 times as high (default: 360)")
    options = parser.parse_args()
    if options.scene == "poster":
        size = {"width": options.width, "height": options.width * 16 // 9}
        scene = SCENES.build("poster", views=options.views, **size)
    else:
        scene = SCENES.build("nerfstudio", path=options.scene)
    print(report(scene))


if __name__ == "__main__":
    main()
