"""What larger images cost and gain: `python -m benchmarks.image_sizes SCENE --sizes 64 128 256 512`.

Trains each scene at each size of its images, given as their longer side in pixels, with each recipe, and measures
held-out PSNR, CPU seconds of training and peak memory. Each training has a process of its own, with one thread. The
model is the strongest MLP pair of docs/findings.md, so that the numbers tell about recipes and not about circuits.

--steps N replaces the recipes' own number of steps, to compare them at equal work. PSNR is measured on at most
`PIXELS` pixels, every so many rows and columns of every held-out view. Rows of the results that are not measured again
stay; each row is saved when it is there.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
import pandas as pd
import torch
from PIL import Image
from qnerf.analysis import figures

from benchmarks.training import build
from qnerf.timing import load, peak_memory_mb
from qnerf.training.image_metrics import psnr

RESULTS = Path(__file__).parent / "results" / "image_sizes.parquet"
MODEL = "field=classical color.directions=raw color.mlp.init=he device=cpu threads=1"
PIXELS = 40_000  # held-out pixels, about
KEYS = ["scene", "size", "recipe", "steps_given", "seed", "extra"]


def image_size(scene: Path) -> tuple[int, int]:
    """Width and height of the scene's first image."""
    frames = json.loads(next(scene.glob("transforms*.json")).read_text())["frames"]
    files = (scene / f"{frame['file_path']}{ending}" for frame in frames for ending in ("", ".png"))
    with Image.open(next(file for file in files if file.is_file())) as opened:
        return opened.size


def source(scene: Path, width: int) -> str:
    """The options that read the scene with images of this width."""
    kind = "blender scene.eval_views=5" if (scene / "transforms_train.json").exists() else "nerfstudio"
    return f"scene={kind} scene.path={scene.absolute()} scene.width={width} scene.skip_missing=true"


def train(overrides: str) -> dict[str, Any]:
    """Trains the configuration to its end, and measures its held-out views."""
    torch.set_num_threads(1)
    trainer, evaluator = build(overrides)
    peak_ready, start = peak_memory_mb(torch.device("cpu")), time.process_time()
    while not trainer.done:
        trainer.take_step(measure=False)
    seconds = time.process_time() - start
    scene = evaluator.scene
    sizes = [scene.cameras.size(view) for view in scene.eval]
    stride = max(1, round((sum(width * height for width, height in sizes) / PIXELS) ** 0.5))
    values = []
    for view in scene.eval:
        rendered = evaluator.render(view, trainer.step, stride)
        values.append(psnr(rendered.color.double(), evaluator.truth(view)[::stride, ::stride].double()))
    return {
        "psnr": float(np.mean(values)),
        "views": len(values),
        "width": sizes[0][0],
        "height": sizes[0][1],
        "training_pixels": len(trainer.table.training),
        "steps": trainer.step,
        "cpu_s": seconds,
        "peak_mb": peak_memory_mb(torch.device("cpu")),
        "read_mb": peak_ready,
        "parameters": sum(p.numel() for p in trainer.model.parameters()),
    }


def stored(path: Path) -> pd.DataFrame:
    return pd.read_parquet(path) if path.exists() else pd.DataFrame(columns=KEYS)


def save(path: Path, row: dict[str, Any]) -> None:
    """Adds the row to the file, in place of an older one with the same keys."""
    old = stored(path)
    same = (old[KEYS] == pd.Series(row)[KEYS]).all(axis=1)
    rows = pd.concat([*([old[~same]] if len(old[~same]) else []), pd.DataFrame([row])], ignore_index=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(f".{os.getpid()}")
    rows.to_parquet(temporary, index=False)
    os.replace(temporary, path)


def report(rows: pd.DataFrame) -> None:
    """Prints a row a training."""
    columns = [
        "scene",
        "size",
        "recipe",
        "extra",
        "seed",
        "steps",
        "psnr",
        "cpu_s",
        "peak_mb",
        "training_pixels",
        "parameters",
    ]
    print(rows.sort_values(["scene", "recipe", "size", "steps"])[columns].round(2).to_string(index=False))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", type=Path, help="folders that scene=nerfstudio or scene=blender reads")
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 128, 256, 512], help="longer side, in pixels")
    parser.add_argument("--recipes", nargs="+", default=["quick", "large"], help="of conf/train")
    parser.add_argument("--steps", type=int, default=0, help="0: the recipe's own")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--overrides", default="", help="of all configurations")
    parser.add_argument("--again", action="store_true", help="repeat what is saved")
    parser.add_argument("--out", type=Path, default=RESULTS, help="file of the results")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="also draw train=large: a png, pdf or svg file")
    parser.add_argument("--one", metavar="OVERRIDES", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.one:
        print(json.dumps(train(options.one)))
        return
    for scene, size, recipe, seed in (
        (a, b, c, d) for a in options.scenes for b in options.sizes for c in options.recipes for d in options.seeds
    ):
        width, height = image_size(scene)
        if max(width, height) < size:
            print(f"{scene.name}: the images have {max(width, height)} pixels, not {size}: left out", flush=True)
            continue
        keys = dict(zip(KEYS, (scene.name, size, recipe, options.steps, seed, options.overrides), strict=True))
        if not options.again and (stored(options.out)[KEYS] == pd.Series(keys)).all(axis=1).any():
            continue
        steps = f"train.steps={options.steps}" if options.steps else ""
        reduced = source(scene, round(size * width / max(width, height)))
        overrides = f"train={recipe} {reduced} {MODEL} seed={seed} {steps} {options.overrides}"
        command = [sys.executable, "-m", "benchmarks.image_sizes", "--one", overrides]
        answer = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout
        row = json.loads(answer.splitlines()[-1])
        save(options.out, keys | row | {"load": load()})
        print(f"{scene.name} {size} px, {recipe}: {row['psnr']:.2f} dB, {row['cpu_s']:.0f} s of CPU", flush=True)
    rows = stored(options.out)
    report(rows)
    if options.figure:
        figures.image_sizes(rows).savefig(options.figure, dpi=200)


if __name__ == "__main__":
    main()
