"""Our models beside nerfstudio's, which nobody here wrote: `python -m benchmarks.nerfstudio --peers-python PYTHON`.

Compares nerfstudio 1.1.5's Nerfacto (its PyTorch implementation, on the CPU) with our classical field, and Nerfacto
with the published quantum colour head (linear colours; our circuit inside) with our `field=qcolor`, all under
`train=paper`. Both sides get the same images, poses, batches of pixels, numbers of samples, table sizes, widths,
losses, schedules of the learning rate and of annealing, and fixed poses, without an appearance embedding. What
differs:

- initial values and jitter are other random numbers;
- nerfstudio trains its proposal networks at every second step at first and at every sixth after step 5,000; we train
  them at every fifth, as the paper says (`--overrides "sampler.update_every=6 sampler.update_warmup=5000"` does the
  former);
- nerfstudio's proposal networks hash their coarse levels, too; ours index them directly;
- the finest level of nerfstudio's hash table has 1,023 cells along a side, ours 1,024.

PYTHON's environment needs qnerf, and nerfstudio without its viewer and rasterisers, which are replaced by empty
stand-ins (`benchmarks.peers.stand_ins`):

    pip install . jaxtyping tyro einops tensorboard && pip install --no-deps nerfstudio==1.1.5

Two parts, chosen by --only; rows of benchmarks/results/nerfstudio.parquet that are not measured again stay:

- quality: held-out PSNR, SSIM and depth error after --steps of one schedule of --schedule steps, over all held-out
  views, from the pictures that each model renders, by our metrics. A case (model, seed) is saved when it ends and
  skipped if its rows exist, so a stopped benchmark continues with the missing cases. --pictures saves a view of each.
- time: milliseconds a step, of all models in turns, 30 steps each time, which is a whole number of both schedules of
  proposal updates; medians. With the peak memory of each process, and its growth since before the model was built.

--functions does something else: it compares contraction, sampling, weights, losses, encodings, schedules and the
gradients of a whole step one by one, and stores nerfstudio's results in tests/numerics.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
import pandas as pd
import torch
from PIL import Image
from qnerf.analysis.statistics import difference, method, paired

from benchmarks.nerfstudio_functions import STORED, differences
from benchmarks.peers.serve import ROOT, Remote
from benchmarks.training import build
from qnerf.geometry.rays import RayTable
from qnerf.training.evaluation import Evaluator, RenderedView
from qnerf.training.trainer import Trainer

RESULTS = Path(__file__).parent / "results" / "nerfstudio.parquet"
FIELDS = {"classical": "field=classical", "qcolor": "field=qcolor qiren=1L2S"}
CASES = [f"{side} {field}" for field in FIELDS for side in ("qnerf", "nerfstudio")]
BACKGROUNDS = {"white": 255.0, "black": 0.0}  # behind images with alpha
METRICS = ["psnr", "ssim", "depth_error"]
CASE = ["kind", "case", "scene", "overrides"]  # what makes two rows the same case
KEYS = {"quality": [*CASE, "schedule", "seed", "step"], "time": [*CASE, "threads"]}
BLOCK = 30  # steps
SETTLED = 6000  # a step at which both schedules of proposal updates are in their final state


def overrides_of(case: str, seed: int, options: argparse.Namespace) -> str:
    """The configuration of both sides of a case."""
    field = FIELDS[case.split()[1]]
    return f"train=paper {field} seed={seed} train.steps={options.schedule} device=cpu {options.overrides}".strip()


def batches(table: RayTable, rays: int, seed: int, steps: int) -> torch.Tensor:
    """The pixels that our trainer draws in each step (steps, R), numbered view by view among all views."""
    generator = torch.Generator().manual_seed(seed)
    numbers = torch.stack([torch.randint(len(table.training), (rays,), generator=generator) for _ in range(steps)])
    views, pixels = table.training.locate(numbers)
    return table.first[views] + pixels


def table_of(trainer: Trainer, evaluator: Evaluator, seed: int, steps: int) -> dict[str, np.ndarray]:
    """The rays, colours and batches that nerfstudio's side needs; see `benchmarks.peers.nerfstudio_models`."""
    table, scene = trainer.table, evaluator.scene
    rays = [table.view(view) for view in range(len(scene.cameras))]
    colors = table.colors
    if colors.shape[-1] == 4:  # as nerfstudio does, when it reads the images
        if trainer.background not in BACKGROUNDS:
            raise ValueError(f"scene {scene.name} has alpha: render.background white or black expected")
        color, alpha = colors[..., :3].float(), colors[..., 3:].float() / 255
        colors = (color * alpha + BACKGROUNDS[trainer.background] * (1 - alpha)).round().to(torch.uint8)
    arrays = {
        "origins": torch.stack([view.origins[0] for view in rays]),
        "directions": torch.cat([view.directions for view in rays]),
        "colors": colors,
        "batches": batches(table, trainer.train.rays, seed, steps).int(),
        "held_out": torch.tensor(scene.eval),
    }
    return {name: tensor.contiguous().numpy() for name, tensor in arrays.items()}


def settings_of(trainer: Trainer, seed: int, threads: int) -> dict[str, Any]:
    """The settings of nerfstudio's side, read from ours.

    It has no other pose refinement, shading or contraction than `train=paper`.
    """
    field, sampler, train = trainer.model.field, trainer.model.sampler, trainer.train
    grid: Any = field.encoder
    head: Any = field.color_head
    hybrid = getattr(head, "hybrid", None)
    levels, size, features = grid.table.shape
    nets: Any = sampler.networks
    return {
        "table": [levels, int(grid.resolutions[0]), int(grid.resolutions[-1]), size.bit_length() - 1, features],
        "views": len(trainer.table.training.views),
        "geo_features": field.density_head.net[-1].out_features - 1,
        "samples": list(sampler.samples),  # type: ignore[call-overload]
        "final": sampler.final,
        "circuit": None if hybrid is None else [len(hybrid) - 1, hybrid[0].circuit.spectral],
        "options": {
            "background_color": trainer.background,
            "near_plane": trainer.table.near,
            "far_plane": trainer.table.far,
            "proposal_net_args_list": [
                {
                    "hidden_dim": net.hidden.out_features,
                    "log2_hashmap_size": net.encoder.table.shape[1].bit_length() - 1,
                    "num_levels": len(net.encoder.table),
                    "max_res": int(net.encoder.resolutions[-1]),
                    "use_linear": False,
                }
                for net in nets
            ],
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


class Bench:
    """Starts models of both sides.

    Args:
        options: of the command line.
        folder: for the files that both sides exchange.
    """

    def __init__(self, options: argparse.Namespace, folder: Path) -> None:
        self.options, self.folder = options, folder

    def start(self, case: str, seed: int, steps: int, threads: int) -> Remote:
        """A model in a process of its own, before its first step; `steps` that it will take."""
        overrides = overrides_of(case, seed, self.options)
        if case.startswith("qnerf"):
            return Remote([sys.executable, "-m", "benchmarks.nerfstudio_ours", overrides, str(threads)], threads)
        trainer, evaluator = build(overrides)
        path = self.folder / f"{case}-{seed}-{threads}.npz"
        np.savez(path, **table_of(trainer, evaluator, seed, steps))  # type: ignore[arg-type]
        settings = json.dumps(settings_of(trainer, seed, threads))
        module = "benchmarks.peers.nerfstudio_models"
        return Remote([self.options.peers_python, "-m", module, str(path), settings], threads)

    def row(self, kind: str, case: str, scene: str) -> dict[str, Any]:
        return {"kind": kind, "case": case, "scene": scene, "overrides": self.options.overrides}

    def train(self, case: str, seed: int) -> pd.DataFrame:
        """Rows of kind `quality`: a row for each held-out view after each of the steps."""
        options = self.options
        _, evaluator = build(overrides_of(case, seed, options))
        scene, rows, taken, seconds = evaluator.scene, [], 0, 0.0
        with self.start(case, seed, max(options.steps), options.threads[0]) as model:
            for step in sorted(options.steps):
                seconds += model.order("steps", count=step - taken)["seconds"]
                taken = step
                path = self.folder / "rendered.npz"
                model.order("render", path=str(path))
                views = rendered(evaluator, path)
                measures = [evaluator.measure(view) for view in views]
                if options.pictures:
                    options.pictures.mkdir(parents=True, exist_ok=True)
                    name = f"{scene.name} {case} {seed} {step}.png".replace(" ", "-")
                    Image.fromarray(evaluator.picture(views[0])).save(options.pictures / name)
                common = self.row("quality", case, scene.name) | {"schedule": options.schedule, "seed": seed}
                common |= {"step": step, "threads": options.threads[0], "ms": 1e3 * seconds / step}
                rows += [common | {key: measure[key] for key in ("image", *METRICS)} for measure in measures]
                mean = np.mean([measure["psnr"] for measure in measures])
                print(f"{case}, seed {seed}: {mean:.2f} dB after {step} steps, {seconds:.0f} s", flush=True)
        return pd.DataFrame(rows)

    def times(self, threads: int) -> pd.DataFrame:
        """Rows of kind `time`: all cases in turns."""
        options = self.options
        blocks: dict[str, list[float]] = {case: [] for case in options.cases}
        models = {case: self.start(case, 0, BLOCK, threads) for case in options.cases}
        for model in models.values():
            model.order("steps", count=BLOCK)
            model.order("advance", step=SETTLED)
        for count in range(options.rounds + 1):
            for case, model in models.items():
                seconds = model.order("steps", count=BLOCK)["seconds"]
                if count:  # the first round warms up
                    blocks[case].append(1e3 * seconds / BLOCK)
        _, evaluator = build(overrides_of(options.cases[0], 0, options))
        rows = []
        for case, model in models.items():
            memory = model.order("memory")
            ms = blocks[case]
            row = self.row("time", case, evaluator.scene.name) | {"threads": threads, "blocks": len(ms)}
            row |= {"ms": median(ms), "ms_low": min(ms), "ms_high": max(ms), "load": os.getloadavg()[0]}
            rows.append(row | {f"{name}_mb": memory[name] / 2**20 for name in ("peak", "growth")})
            model.close()
        return pd.DataFrame(rows)


def rendered(evaluator: Evaluator, path: Path) -> list[RenderedView]:
    """The held-out views that a model wrote."""
    cameras, views = evaluator.scene.cameras, evaluator.scene.eval
    shape = (len(views), cameras.height, cameras.width)
    with np.load(path) as file:
        color = torch.from_numpy(file["color"]).view(*shape, 3)
        depth, accumulation = (torch.from_numpy(file[name]).view(shape) for name in ("depth", "accumulation"))
    return [RenderedView(view, *parts) for view, *parts in zip(views, color, depth, accumulation, strict=True)]


def stored() -> pd.DataFrame:
    return pd.read_parquet(RESULTS) if RESULTS.exists() else pd.DataFrame(columns=["kind"])


def save(rows: pd.DataFrame) -> None:
    """Adds the rows to the file, in place of older ones of the same case."""
    old, kind = stored(), rows["kind"].iloc[0]
    if len(old):
        keys = pd.MultiIndex.from_frame(rows[KEYS[kind]])
        same = (old["kind"] == kind) & old.reindex(columns=KEYS[kind]).set_index(KEYS[kind]).index.isin(keys)
        rows = pd.concat([old[~same], rows], ignore_index=True)
    RESULTS.parent.mkdir(exist_ok=True)
    temporary = RESULTS.with_suffix(f".{os.getpid()}")
    rows.to_parquet(temporary, index=False)
    os.replace(temporary, RESULTS)


def has(case: str, scene: str, seed: int, options: argparse.Namespace) -> bool:
    """Whether all steps of the case are in the file."""
    rows = stored().query("kind == 'quality'")
    if not len(rows):
        return False
    same = (rows["case"] == case) & (rows["scene"] == scene) & (rows["overrides"] == options.overrides)
    same &= (rows["schedule"] == options.schedule) & (rows["seed"] == seed)
    return set(options.steps) <= set(rows[same]["step"])


def report(rows: pd.DataFrame) -> None:
    """Prints the means, and ours less nerfstudio's, paired by seed and view."""
    quality, times = rows[rows["kind"] == "quality"], rows[rows["kind"] == "time"]
    if len(quality):
        groups = quality.groupby(["scene", "overrides", "schedule", "step", "case"])
        table = groups[METRICS].mean().join(groups["seed"].nunique().rename("seeds"))
        print(table.to_string(float_format="{:.3f}".format))
        for name, part in quality.groupby(["scene", "overrides", "schedule", "step"]):
            scene, overrides, schedule, step = name
            same = (quality["scene"] == scene) & (quality["schedule"] == schedule) & (quality["step"] == step)
            for field in FIELDS:
                ours, theirs = (part[part["case"] == f"{side} {field}"] for side in ("qnerf", "nerfstudio"))
                if not len(theirs) and "sampler." in overrides:  # an option that nerfstudio's side does not have
                    theirs = quality[same & (quality["case"] == f"nerfstudio {field}") & (quality["overrides"] == "")]
                result = difference(paired(*(side.rename(columns={"psnr": "value"}) for side in (theirs, ours))))
                if result is not None:
                    bounds = f"{result.mean:+.2f} dB ({result.low:+.2f} to {result.high:+.2f})"
                    print(f"{' '.join(map(str, name))} {field}: qnerf - nerfstudio {bounds}, {result.seeds} seeds")
        print(method())
    if len(times):
        ms = times.pivot(index=["scene", "overrides", "threads"], columns="case", values="ms")
        ratios = {
            f"{field}, times": ms[f"nerfstudio {field}"] / ms[f"qnerf {field}"]
            for field in FIELDS
            if {f"nerfstudio {field}", f"qnerf {field}"} <= set(ms.columns)
        }
        print(times[["case", "threads", "ms", "ms_low", "ms_high", "blocks", "peak_mb", "growth_mb"]].to_string())
        print(ms.assign(**ratios).to_string(float_format="{:.1f}".format))


def functions(peers_python: str) -> None:
    """Stores nerfstudio's results, and prints how far ours are from them."""
    command = [peers_python, "-m", "benchmarks.peers.nerfstudio_functions", str(STORED)]
    subprocess.run(command, cwd=ROOT, check=True)
    print(differences().to_string(index=False, float_format="{:.1e}".format))


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peers-python", default=sys.executable, help="interpreter of nerfstudio's environment")
    parser.add_argument("--functions", action="store_true", help="compare function by function instead")
    parser.add_argument("--report", action="store_true", help="print the saved results instead of measuring")
    parser.add_argument("--only", choices=["quality", "time"], nargs="+", default=["time", "quality"])
    parser.add_argument("--cases", nargs="+", choices=CASES, default=CASES, metavar="CASE", help=", ".join(CASES))
    parser.add_argument("--steps", type=int, nargs="+", default=[1000, 3000, 10000], help="when views are rendered")
    parser.add_argument("--schedule", type=int, default=10000, help="steps of the learning rate's schedule")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--overrides", default="", help="of both sides: of scene, hash, proposal and train")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="of time; quality uses the first")
    parser.add_argument("--rounds", type=int, default=7, help="blocks of steps for each model and number of threads")
    parser.add_argument("--again", action="store_true", help="repeat quality cases that are saved")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="save one held-out view of each case")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    if options.functions:
        functions(options.peers_python)
        return
    if not options.report:
        with tempfile.TemporaryDirectory() as folder:
            try:
                measure(Bench(options, Path(folder)))
            except RuntimeError as error:  # of a model's process
                raise SystemExit(f"{error} (the environment of --peers-python is described by --help)") from error
    report(stored())


def measure(bench: Bench) -> None:
    """Measures what the options ask for, and saves each part when it is done."""
    options = bench.options
    if "time" in options.only:
        for threads in options.threads:
            save(bench.times(threads))
    if "quality" in options.only:
        _, evaluator = build(overrides_of(options.cases[0], 0, options))
        for seed in options.seeds:
            for case in options.cases:
                if options.again or not has(case, evaluator.scene.name, seed, options):
                    save(bench.train(case, seed))


if __name__ == "__main__":
    main()
