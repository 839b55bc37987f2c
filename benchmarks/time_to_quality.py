"""CPU seconds to a fixed quality: `python -m benchmarks.time_to_quality STORE --levels 29.35 30.35`.

Reads trainings of different lengths from a store, which `python -m src.run --sweep time` makes, and prints for each
scene and head the CPU seconds after which held-out views reach a PSNR. Between two trainings they lie evenly in the
logarithm. They are steps times the median CPU time of a step; compiling, reading the scene and evaluation do not count.
"""

import argparse
import math
from collections.abc import Sequence
from itertools import pairwise
from statistics import median

from qnerf.analysis.load import runs
from qnerf.analysis.selection import select


def seconds_to(level: float, rungs: Sequence[tuple[float, float]]) -> float:
    """Seconds at which rungs (seconds, PSNR) reach the level: at most those of the first, infinity if none does.

    >>> seconds_to(25.0, [(1.0, 20.0), (4.0, 30.0)])
    2.0
    """
    if rungs[0][1] >= level:
        return rungs[0][0]
    for (before, low), (after, high) in pairwise(rungs):
        if high >= level:
            return before * math.exp(math.log(after / before) * (level - low) / (high - low))
    return math.inf


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store", help="a folder of runs, such as docs/results/time")
    parser.add_argument("--levels", nargs="+", type=float, default=[29.35, 30.35], help="PSNR, dB")
    options = parser.parse_args()
    frame = select(runs(options.store), "step_cpu_ms").runs.sort_values("steps")
    frame["cpu_s"] = frame["steps"] * frame["step_cpu_ms"] / 1e3
    for (scene, density, color), own in frame.groupby(["scene_name", "density", "color"]):
        seeds = [list(zip(rungs["cpu_s"], rungs["psnr"], strict=True)) for _, rungs in own.groupby("seed")]
        found = []
        for level in options.levels:
            bound = "at most " * any(one[0][1] >= level for one in seeds)
            found.append(f"{level:g} dB {bound}{median(seconds_to(level, one) for one in seeds):.1f} s")
        print(f"{scene}, density {density}, colour {color}, {len(seeds)} seeds: {', '.join(found)}")


if __name__ == "__main__":
    main()
