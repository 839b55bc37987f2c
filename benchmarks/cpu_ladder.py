"""What seconds of CPU buy: `python -m benchmarks.cpu_ladder --scenes poster /data/chair /data/fox`.

Held-out PSNR against seconds of training, of one process on --threads cores, for each scene, width of its images and
model in `CASES`. With one thread these are seconds of CPU time, so that other processes on the machine change little;
with more threads, seconds on the clock. Every budget of seconds is a training of its own, whose schedule ends when the
budget does: the time of a step is measured first, in a process that is thrown away. Reading the scene, compiling,
building the model and evaluation are not counted.

The peer is nerfstudio 1.1.5's Nerfacto in its PyTorch implementation, with the recipe of its publication
(`train=paper`) and with the sizes of our quick one. Both sides get the same rays, colours, batches of pixels, numbers
of samples, sizes, losses and schedules, and fixed poses without an appearance embedding. The environment of
--peers-python needs qnerf, and nerfstudio without its viewer and rasterisers:

    pip install . jaxtyping tyro einops tensorboard && pip install --no-deps nerfstudio==1.1.5

A model that cannot be trained on a scene gets a row with the error in place of numbers. Rows of the results that are
not measured again stay. A stopped benchmark continues with what is missing.
"""

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
import pandas as pd
import torch
from qnerf.analysis.figures import psnr_vs_cpu_seconds

from benchmarks.peers.serve import Remote, serve
from benchmarks.training import build
from qnerf import kernels
from qnerf.timing import load
from qnerf.training.evaluation import Evaluator, RenderedView
from qnerf.training.trainer import Trainer

RESULTS = Path(__file__).parent / "results" / "cpu_ladder.parquet"
AMPLITUDE = "head@density=amplitude head@color=mlp color.directions=raw color.mlp.init=he"
CASES = {  # name -> who trains, overrides
    "qnerf classical": ("qnerf", "field=classical"),
    "qnerf classical, large": ("qnerf", "train=large field=classical"),
    "qnerf amplitude density": ("qnerf", AMPLITUDE),
    "qnerf qcolor": ("qnerf", "field=qcolor"),
    "plain PyTorch classical": ("plain", "field=classical"),
    "Nerfacto": ("nerfstudio", "train=paper field=classical"),
    "Nerfacto, quick sizes": ("nerfstudio", "field=classical"),
}
KEYS = ["scene", "width", "case", "budget_s", "seed", "threads", "overrides"]
WARM, TIMED, BLOCK = 20, 20, 5  # steps
BATCHES = 2000  # different batches of pixels that Nerfacto gets; then the first one comes again
BACKGROUNDS = {"white": 255.0, "black": 0.0}  # behind images with alpha


class Ours:
    """Our model as a served one, on the CPU."""

    def __init__(self, overrides: str) -> None:
        self.trainer, self.evaluator = build(overrides)

    def take_step(self) -> None:
        self.trainer.take_step(measure=False)

    def render(self, path: str) -> None:
        views = [self.evaluator.render(view, self.trainer.step) for view in self.evaluator.scene.eval]
        names = ("color", "depth", "accumulation")
        np.savez(path, **{name: torch.stack([getattr(view, name) for view in views]).numpy() for name in names})  # type: ignore[arg-type]


def table_of(trainer: Trainer, evaluator: Evaluator, seed: int, steps: int) -> dict[str, np.ndarray]:
    """The rays, colours and batches that our trainer draws, for `benchmarks.peers.nerfstudio_models`."""
    table, scene = trainer.table, evaluator.scene
    rays = [table.view(view) for view in range(len(scene.cameras))]
    colors = table.colors
    if colors.shape[-1] == 4:  # as nerfstudio does, when it reads the images
        if trainer.background not in BACKGROUNDS:
            raise ValueError(f"scene {scene.name} has alpha: render.background white or black expected")
        color, alpha = colors[..., :3].float(), colors[..., 3:].float() / 255
        colors = (color * alpha + BACKGROUNDS[trainer.background] * (1 - alpha)).round().to(torch.uint8)
    generator = torch.Generator().manual_seed(seed)
    drawn = [torch.randint(len(table.training), (trainer.train.rays,), generator=generator) for _ in range(steps)]
    views, pixels = table.training.locate(torch.stack(drawn))
    arrays = {
        "origins": torch.stack([view.origins[0] for view in rays]),
        "directions": torch.cat([view.directions for view in rays]),
        "colors": colors,
        "batches": (table.first[views] + pixels).int(),
        "held_out": torch.tensor(scene.eval),
    }
    return {name: tensor.contiguous().numpy() for name, tensor in arrays.items()}


def settings_of(trainer: Trainer, seed: int, threads: int) -> dict[str, Any]:
    """The settings of nerfstudio's side, read from ours."""
    model: Any = trainer.model  # its hash grids, layers and proposal networks
    train, grid, sampler = trainer.train, model.field.encoder, model.sampler
    levels, size, features = grid.table.shape
    networks = [
        {
            "hidden_dim": net.hidden.out_features,
            "log2_hashmap_size": net.encoder.table.shape[1].bit_length() - 1,
            "num_levels": len(net.encoder.table),
            "max_res": int(net.encoder.resolutions[-1]),
            "use_linear": False,
        }
        for net in sampler.networks
    ]
    return {
        "table": [levels, int(grid.resolutions[0]), int(grid.resolutions[-1]), size.bit_length() - 1, features],
        "views": len(trainer.table.training.views),
        "geo_features": model.field.density_head.net[-1].out_features - 1,
        "samples": list(sampler.samples),
        "final": sampler.final,
        "options": {
            "background_color": trainer.background,
            "near_plane": trainer.table.near,
            "far_plane": trainer.table.far,
            "proposal_net_args_list": networks,
            "interlevel_loss_mult": train.interlevel,
            "distortion_loss_mult": train.distortion,
        },
        "seed": seed,
        "rate": train.lr,
        "final_rate": train.lr_final / train.lr,
        "eps": train.eps,
        "steps": train.steps,
        "near": trainer.table.near,
        "far": trainer.table.far,
        "threads": threads,
    }


def rendered(evaluator: Evaluator, path: Path) -> list[RenderedView]:
    """The held-out views that a model wrote."""
    cameras, views = evaluator.scene.cameras, evaluator.scene.eval
    shape = (len(views), cameras.height, cameras.width)
    with np.load(path) as file:
        color = torch.from_numpy(file["color"]).view(*shape, 3)
        depth, accumulation = (torch.from_numpy(file[name]).view(shape) for name in ("depth", "accumulation"))
    return [RenderedView(view, *parts) for view, *parts in zip(views, color, depth, accumulation, strict=True)]


def overrides_of(scene: str, width: int, case: str, seed: int, steps: int, extra: str) -> str:
    """The configuration of a training. scene: poster, or a folder of nerfstudio or synthetic NeRF."""
    if scene == "poster":  # its pixels stay square
        source = f"scene=poster scene.height={width * 16 // 9}"
    else:
        layout = "blender" if (Path(scene) / "transforms_train.json").exists() else "nerfstudio"
        source = f"scene={layout} scene.path={Path(scene).absolute()}"
    return f"{source} scene.width={width} {CASES[case][1]} seed={seed} train.steps={steps} device=cpu {extra}".strip()


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
            return Remote(
                [sys.executable, "-m", "benchmarks.cpu_ladder", "--serve", side, overrides, "--threads", str(threads)],
                threads,
            )
        trainer, evaluator = build(overrides)
        np.savez(self.folder / "rays.npz", **table_of(trainer, evaluator, seed, BATCHES))  # type: ignore[arg-type]
        settings = json.dumps(settings_of(trainer, seed, threads))
        module = [self.options.peers_python, "-m", "benchmarks.peers.nerfstudio_models"]
        return Remote([*module, str(self.folder / "rays.npz"), settings], threads)

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
        measures = [evaluator.measure(view) for view in rendered(evaluator, self.folder / "rendered.npz")]
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
        done = set(stored(options.out)[KEYS].itertuples(index=False, name=None))
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
            print(f"{Path(scene).name} {width} px, {case}: not trained: {reason}", flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["poster"], help="poster, or folders of images with poses")
    parser.add_argument("--widths", type=int, nargs="+", default=[64, 128, 256], help="of the images, in pixels")
    parser.add_argument("--budgets", type=float, nargs="+", default=[15.0, 60.0], help="in seconds")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES), metavar="CASE", help=", ".join(CASES))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--threads", type=int, default=1, help="1: budgets are seconds of CPU time")
    parser.add_argument("--overrides", default="", help="of all configurations")
    parser.add_argument("--peers-python", default=sys.executable, help="interpreter of nerfstudio's environment")
    parser.add_argument("--out", type=Path, default=RESULTS, help="file of the results")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="also draw it: a png, pdf or svg file")
    parser.add_argument("--serve", nargs=2, help=argparse.SUPPRESS)  # the process of one of our models
    options = parser.parse_args(arguments)
    torch.set_num_threads(options.threads)
    if options.serve:
        side, overrides = options.serve
        with kernels.plain() if side == "plain" else nullcontext():
            serve(lambda: Ours(overrides))
        return
    with tempfile.TemporaryDirectory() as folder:
        measure(Ladder(options, Path(folder)))
    trained = stored(options.out).dropna(subset=["psnr"])
    groups = trained.groupby(["scene", "width", "case", "budget_s"], sort=False)
    print(groups["psnr"].mean().unstack("budget_s").to_string(float_format="{:.2f} dB".format))
    if options.figure:
        psnr_vs_cpu_seconds(stored(options.out)).savefig(options.figure, dpi=200)


if __name__ == "__main__":
    main()
