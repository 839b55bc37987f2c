"""How long a picture of a trained model takes: `python -m benchmarks.frames RUN [RUN ...]`.

RUN is a run's folder. It renders frames at several sizes from a few training cameras, as `qnerf render` and the viewer
do; the model has been loaded and its kernels are compiled. Prints the median seconds of a frame on each number of
threads, and saves them to benchmarks/results/frames.parquet.
"""

import argparse
import os
import time
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
import pandas as pd
import torch

from qnerf.cli.commands.render import size
from qnerf.cli.upgrade_config import load_stored
from qnerf.geometry.camera_paths import Camera, interpolate
from qnerf.timing import load
from qnerf.viewing.frames import Renderer

RESULTS = Path(__file__).parent / "results" / "frames.parquet"
SIZES = ["64x36", "128x128", "640x360"]


def measure(renderer: Renderer, width: int, height: int, frames: int) -> list[float]:
    """Seconds of each frame; a first one is not counted."""
    scene = renderer.trained.scene
    poses = interpolate(scene.cameras.poses.numpy()[scene.train], frames + 1)
    seconds = []
    for pose in poses:
        start = time.perf_counter()
        renderer.frame(Camera(pose, renderer.focal(width, height), width, height))
        seconds.append(time.perf_counter() - start)
    return seconds[1:]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folders of runs")
    parser.add_argument("--sizes", type=size, nargs="+", default=list(map(size, SIZES)), metavar="WxH")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--frames", type=int, default=4, help="of each size (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=RESULTS, help="file of the results")
    options = parser.parse_args()
    rows = []
    for run in options.runs:
        renderer = Renderer(load_stored(run, []))
        for threads in options.threads:
            torch.set_num_threads(threads)
            for width, height in options.sizes:
                seconds = measure(renderer, width, height, options.frames)
                median = float(np.median(seconds))
                row = {"scene": run.name.split("-")[0], "run": run.name, "width": width, "height": height}
                rows.append(row | {"threads": threads, "seconds": median, "frames": options.frames, "load": load()})
    table = pd.DataFrame(rows)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    table.to_parquet(options.out, index=False)
    print(table.round(3).to_string(index=False))


if __name__ == "__main__":
    main()
