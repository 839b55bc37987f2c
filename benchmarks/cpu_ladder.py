"""What seconds of CPU buy: `python -m benchmarks.cpu_ladder --scenes poster /data/chair /data/fox`.

Held-out PSNR against seconds of training, of one process on --threads cores, for each scene, width of its images and
model in `CASES`. With one thread these are seconds of CPU time, so that other processes on the machine change little;
with more threads, seconds on the clock. Every budget of seconds is a training of its own, whose schedule ends when the
budget does: the time of a step is measured first, in a process that is thrown away. Reading the scene, compiling,
building the model and evaluation are not counted.

The peers are nerfstudio's Nerfacto in its PyTorch implementation, with the recipe of its publication (`train=paper`)
and with the sizes of our quick one, and its TensoRF with its own options, for scenes of synthetic NeRF. See
`benchmarks.nerfstudio` for what both sides share and for the environment of --peers-python. A model that cannot be
trained on a scene gets a row with the error in place of numbers.

Rows of the results that are not measured again stay. A stopped benchmark continues with what is missing. Load is
recorded with each row: with several threads, measure on a quiet machine.
"""

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
import pandas as pd
import torch
from qnerf.analysis.figures import psnr_vs_cpu_seconds

from benchmarks.nerfstudio import rendered, settings_of, table_of
from benchmarks.peers.serve import Remote
from benchmarks.training import build
from qnerf.scenes import Scene
from qnerf.timing import load

RESULTS = Path(__file__).parent / "results" / "cpu_ladder.parquet"
CASES = {  # name -> who trains, overrides
    "qnerf classical": ("qnerf", "field=classical"),
    "qnerf classical, large": ("qnerf", "train=large field=classical"),
    "qnerf amplitude density": (
        "qnerf",
        "head@density=amplitude head@color=mlp color.directions=raw color.mlp.init=he",
    ),
    "qnerf qcolor": ("qnerf", "field=qcolor"),
    "plain PyTorch classical": ("plain", "field=classical"),
    "Nerfacto": ("nerfstudio", "train=paper field=classical"),
    "Nerfacto, quick sizes": ("nerfstudio", "field=classical"),
    "TensoRF": ("nerfstudio", "field=classical"),
}
TENSORF = {"rates": {"fields": 1e-3, "encodings": 2e-2}, "final_rate": 0.1, "eps": 1e-8}  # nerfstudio's own
BOX = 1.5  # half the side of the cube that holds a scene of synthetic NeRF, in its units
KEYS = ["scene", "width", "case", "budget_s", "seed", "threads", "overrides"]
WARM, TIMED, BLOCK = 20, 20, 5  # steps
BATCHES = 2000  # different batches of pixels that Nerfacto gets; then the first one comes again


def overrides_of(scene: str, width: int, case: str, seed: int, steps: int, extra: str) -> str:
    """The configuration of a training. scene: poster, or a folder of nerfstudio or synthetic NeRF."""
    if scene == "poster":  # its pixels stay square
        source = f"scene=poster scene.height={width * 16 // 9}"
    else:
        layout = "blender" if (Path(scene) / "transforms_train.json").exists() else "nerfstudio"
        source = f"scene={layout} scene.path={Path(scene).absolute()}"
    return f"{source} scene.width={width} {CASES[case][1]} seed={seed} train.steps={steps} device=cpu {extra}".strip()


def box_of(scene: Scene) -> float:
    """Half the side of the cube that holds the scene, in world units; ValueError where none is known."""
    if not scene.has_alpha:
        raise ValueError(f"scene {scene.name}: TensoRF needs a bounded scene, as those of synthetic NeRF are")
    return BOX * float(torch.linalg.det(scene.transform[:3, :3])) ** (1 / 3)


class Ladder:
    """Trains the models.

    Args:
        options: of the command line.
        folder: for the files that both processes exchange.
    """

    def __init__(self, options: argparse.Namespace, folder: Path) -> None:
        self.options, self.folder = options, folder
        self.clock = "cpu" if options.threads == 1 else "seconds"

    def start(self, case: str, overrides: str, seed: int) -> Remote:
        """A model in a process of its own, before its first step."""
        threads, side = self.options.threads, CASES[case][0]
        if side != "nerfstudio":
            module = [sys.executable, "-m", "benchmarks.nerfstudio_ours", overrides, str(threads)]
            return Remote([*module, *(["plain"] if side == "plain" else [])], threads)
        trainer, evaluator = build(overrides)
        np.savez(self.folder / "rays.npz", **table_of(trainer, evaluator, seed, BATCHES))  # type: ignore[arg-type]
        settings = settings_of(trainer, seed, threads)
        if case == "TensoRF":
            settings |= TENSORF | {"half_extent": box_of(evaluator.scene), "background": trainer.background}
        module = [self.options.peers_python, "-m", "benchmarks.peers.nerfstudio_models"]
        return Remote([*module, str(self.folder / "rays.npz"), json.dumps(settings)], threads)

    def step_seconds(self, scene: str, width: int, case: str) -> float:
        """Mean time of a step after the first `WARM`, which compile."""
        overrides = overrides_of(scene, width, case, 0, WARM + TIMED, self.options.overrides)
        with self.start(case, overrides, 0) as model:
            model.order("steps", count=WARM)
            return float(model.order("steps", count=TIMED)[self.clock]) / TIMED

    def train(self, scene: str, width: int, case: str, budget: float, seed: int, a_step: float) -> dict[str, Any]:
        """Trains for `budget` seconds and measures all held-out views. `a_step`: the expected seconds of a step."""
        planned = max(round(budget / a_step), 1)
        overrides = overrides_of(scene, width, case, seed, planned, self.options.overrides)
        _, evaluator = build(overrides)
        steps, seconds = 0, 0.0
        with self.start(case, overrides, seed) as model:
            while steps < planned and seconds < budget:
                taken = min(BLOCK, planned - steps)
                answer = model.order("steps", count=taken)
                steps, seconds = steps + taken, seconds + answer[self.clock]
            model.order("render", path=str(self.folder / "rendered.npz"))
        views = rendered(evaluator, self.folder / "rendered.npz")
        measures = [evaluator.measure(view) for view in views]
        quality = {key: float(np.mean([measure[key] for measure in measures])) for key in ("psnr", "ssim")}
        return quality | {"steps": steps, "planned": planned, "seconds": seconds, "load": load()}


def stored(path: Path) -> pd.DataFrame:
    return pd.read_parquet(path) if path.exists() else pd.DataFrame(columns=[*KEYS, "psnr", "error"])


def save(path: Path, row: dict[str, Any]) -> None:
    """Adds the row to the file, in place of an older one with the same keys."""
    old = stored(path)
    same = (old[KEYS] == pd.Series(row)[KEYS]).all(axis=1)
    rows = pd.concat([*([old[~same]] if len(old[~same]) else []), pd.DataFrame([row])], ignore_index=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(f".{os.getpid()}")
    rows.to_parquet(temporary, index=False)
    os.replace(temporary, path)


def measure(ladder: Ladder) -> None:
    """Measures what the options ask for and the file lacks. Each training is saved when it ends."""
    options = ladder.options
    for scene, width, case in ((s, w, c) for s in options.scenes for w in options.widths for c in options.cases):
        wanted = [
            {"scene": Path(scene).name, "width": width, "case": case, "budget_s": budget, "seed": seed}
            | {"threads": options.threads, "overrides": options.overrides}
            for seed in options.seeds
            for budget in options.budgets
        ]
        done = set() if options.again else set(stored(options.out)[KEYS].itertuples(index=False, name=None))
        wanted = [keys for keys in wanted if tuple(keys.values()) not in done]
        try:
            a_step = ladder.step_seconds(scene, width, case) if wanted else 0.0
            for keys in wanted:
                row = ladder.train(scene, width, case, keys["budget_s"], keys["seed"], a_step)
                save(options.out, keys | row | {"error": ""})
                numbers = f"{row['psnr']:.2f} dB after {row['steps']} steps in {row['seconds']:.0f} s"
                print(f"{keys['scene']} {width} px, {case}, seed {keys['seed']}: {numbers}", flush=True)
        except (RuntimeError, ValueError, OSError) as error:  # of the scene, of the peer's environment
            reason = " ".join(str(error).split())
            for keys in wanted:
                save(options.out, keys | {"psnr": float("nan"), "error": reason})
            print(f"{Path(scene).name} {width} px, {case}: {reason}", flush=True)


def report(rows: pd.DataFrame) -> None:
    """Prints PSNR by budget, means over seeds, and what could not be trained."""
    trained = rows[rows["psnr"].notna()]
    if len(trained):
        groups = trained.groupby(["scene", "width", "case", "budget_s"], sort=False)
        print(groups["psnr"].mean().unstack("budget_s").to_string(float_format="{:.2f}".format))
        print(f"PSNR in dB after a budget of seconds; load {trained['load'].min():.1f} to {trained['load'].max():.1f}")
    for (case, reason), part in rows[rows["psnr"].isna()].groupby(["case", "error"]):
        print(f"{case}: not trained on {', '.join(sorted(set(part['scene'])))}: {reason}")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["poster"], help="poster, or folders of images with poses")
    parser.add_argument("--widths", type=int, nargs="+", default=[64, 128, 256], help="of the images, in pixels")
    parser.add_argument("--budgets", type=float, nargs="+", default=[15.0, 30.0, 60.0, 120.0], help="in seconds")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES), metavar="CASE", help=", ".join(CASES))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--threads", type=int, default=1, help="1: budgets are seconds of CPU time")
    parser.add_argument("--overrides", default="", help="of all configurations")
    parser.add_argument("--peers-python", default=sys.executable, help="interpreter of nerfstudio's environment")
    parser.add_argument("--again", action="store_true", help="repeat what is saved")
    parser.add_argument("--report", action="store_true", help="print the saved results instead of measuring")
    parser.add_argument("--out", type=Path, default=RESULTS, help="file of the results")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="also draw it: a png, pdf or svg file")
    options = parser.parse_args(arguments)
    torch.set_num_threads(options.threads)
    if not options.report:
        with tempfile.TemporaryDirectory() as folder:
            measure(Ladder(options, Path(folder)))
    rows = stored(options.out)
    report(rows)
    if options.figure:
        psnr_vs_cpu_seconds(rows).savefig(options.figure, dpi=200)


if __name__ == "__main__":
    main()
