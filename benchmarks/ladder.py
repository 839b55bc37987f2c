"""CPU seconds to a fixed quality: `python -m benchmarks.ladder --scenes poster FOX`.

Each scene has a level: the held-out PSNR of the default run with the options that it had at first (`BEFORE`), and a
second one a decibel above. Each contender of `CONTENDERS` is trained on one thread with more and more steps, each time
from the start, because the learning rate is planned for its number of steps. The seconds to a level lie between the two
trainings around it, evenly in the logarithm. Compiling, reading the scene and evaluation do not count.

Prints a table, and saves each training as benchmarks/results/ladder.parquet, with the processor and the commit.
"""

import argparse
import math
import os
import time
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import mean, median

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import pandas as pd
import torch

from benchmarks.training import RAW, Row, build, processor
from qnerf.records.environment import capture

RESULTS = Path(__file__).parent / "results" / "ladder.parquet"
BEFORE = "train.steps=3000 train.schedule=exponential train.cooldown=1 train.lr_final=1e-4 train.betas=[0.9,0.999]"
COLORS = "color.directions=raw color.mlp.init=he"
CONTENDERS = {
    "classical": RAW,
    "qcolor": "field=qcolor",
    "qdensity": f"field=qdensity {COLORS}",
    "amplitude": f"head@density=amplitude head@color=mlp {COLORS}",
    "siren": "head@color=siren",
}
STEPS = [round(375 * 2 ** (half / 2)) for half in range(10)]  # 375 to 8,485


def scene_options(scene: str) -> str:
    """scene: poster, or a folder of nerfstudio or synthetic NeRF."""
    if scene == "poster":
        return "scene=poster"
    kind = "blender" if (Path(scene) / "transforms_train.json").exists() else "nerfstudio"
    return f"scene={kind} scene.path={Path(scene).absolute()} scene.width=64"


def trained(overrides: str) -> dict[str, float]:
    """A whole training: its steps, its CPU seconds, and the mean PSNR of all held-out views."""
    trainer, evaluator = build(overrides)
    start, cpu = time.perf_counter(), time.process_time()
    while not trainer.done:
        trainer.take_step(measure=False)
    seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
    views = evaluator.views(evaluator.scene.eval, trainer.step)
    psnr = mean(float(measures["psnr"] or 0) for _, measures in views)
    return {"steps": trainer.step, "cpu_s": cpu, "seconds": seconds, "psnr": psnr}


def climbed(overrides: str, top: float) -> Iterator[dict[str, float]]:
    """Trainings of more and more steps, until one reaches the PSNR `top`."""
    for steps in STEPS:
        row = trained(f"{overrides} train.steps={steps}")
        yield row
        if row["psnr"] >= top:
            return


def seconds_to(level: float, rungs: Sequence[tuple[float, float]]) -> float:
    """Seconds at which rungs (seconds, PSNR) first reach the level; infinity where none does.

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
    parser.add_argument("--scenes", nargs="+", default=["poster"], help="poster, or folders of scenes")
    parser.add_argument("--contenders", nargs="+", choices=CONTENDERS, default=list(CONTENDERS))
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    torch.set_num_threads(1)
    about = {"processor": processor(), "commit": capture()["git"]["commit"]}
    rows: list[Row] = []
    for scene in options.scenes:
        source = scene_options(scene)
        level = median(trained(f"{source} {BEFORE} seed={seed}")["psnr"] for seed in range(options.seeds))
        for name in options.contenders:
            trained(f"{source} {CONTENDERS[name]} train.steps=30")  # compiles
            found = []
            for seed in range(options.seeds):
                rungs = [*climbed(f"{source} {CONTENDERS[name]} seed={seed}", level + 1)]
                rows += [
                    {"scene": Path(scene).name, "contender": name, "seed": seed, "level": level, **row, **about}
                    for row in rungs
                ]
                points = [(row["cpu_s"], row["psnr"]) for row in rungs]
                found.append([seconds_to(level + above, points) for above in (0, 1)])
                pd.DataFrame(rows).to_parquet(RESULTS, index=False)
            first, second = map(median, zip(*found, strict=True))
            print(
                f"{Path(scene).name:<10} {name:<10} {level:6.2f} dB {first:7.1f} s, a decibel more {second:7.1f} s",
                flush=True,
            )


if __name__ == "__main__":
    main()
