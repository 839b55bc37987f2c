"""What computing less gains in time and costs in quality: `python -m benchmarks.speed_error --store DIR`.

Climbs a ladder with two kinds of rungs on each scene:

- The same trained weights, rendered in cheaper and cheaper ways: float64 and float32 on the plain PyTorch references,
  the compiled loops, colours at fewer points, fewer samples. Each picture is compared with that of the first rung.
- Fields that are trained with a rung: everything that Nerfacto has (needs=full), the recipe with and without shading
  fewer points, only what the scene needs (needs=auto), smaller heads. The runs are in the store; finished ones are
  reused.

Step times are measured in turn in one process, at the trained weights. Prints the tables and the paired differences of
`PAIRS`, and saves both in benchmarks/results.
"""

import argparse
import os
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
import pandas as pd
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from qnerf.analysis import load, statistics

import qnerf.cli.resolvers  # noqa: F401  the configuration needs them
from benchmarks.training import Plain, in_turn
from qnerf import experiment
from qnerf.building.model import build_model, ray_table
from qnerf.building.scene import prepare
from qnerf.config.folders import CONF
from qnerf.quantum import QuantumLayer
from qnerf.timing import Stopwatch
from qnerf.training.evaluation import Evaluator, RenderedView
from qnerf.training.trainer import Trainer

RESULTS = Path(__file__).parent / "results" / "speed_error.parquet"
DIFFERENCES = RESULTS.with_name("speed_error_differences.parquet")


@dataclass(frozen=True)
class Rung:
    """A way to compute less: overrides of the configuration.

    plain: computed by the plain PyTorch references; single: trained with one seed only.
    """

    name: str
    overrides: tuple[str, ...] = ()
    plain: bool = False
    single: bool = False

    @property
    def context(self) -> AbstractContextManager[None]:
        return Plain() if self.plain else nullcontext()


SAME_WEIGHTS = (
    Rung("float64, plain PyTorch", ("numerics.dtype=float64",), plain=True),
    Rung("float32, plain PyTorch", plain=True),
    Rung("compiled loops"),
    Rung("threshold 1e-3", ("shading=threshold",)),
    Rung("threshold 1e-2", ("shading=threshold", "shading.min_share=1e-2")),
    Rung("top 8", ("shading=top",)),
    Rung("merge 16", ("shading=merge", "shading.parts=16")),
    Rung("merge 8", ("shading=merge",)),
    Rung("merge 4", ("shading=merge", "shading.parts=4")),
    Rung("merge 8, twice the proposals", ("shading=merge", "proposal.samples=[128,64]")),
    Rung("merge 8, half of all samples", ("shading=merge", "proposal.samples=[32,16]", "proposal.final=16")),
)
TRAINED = (
    Rung(
        "recipe, shading=none, plain PyTorch", ("shading=none",), plain=True, single=True
    ),  # on the built-in scene alone
    Rung("full", ("needs=full",)),
    Rung("recipe, shading=none", ("shading=none",)),
    Rung("recipe"),
    Rung("auto", ("needs=auto",)),
    Rung("auto, 1L1S", ("needs=auto", "qiren=1L1S"), single=True),
    Rung("full, MLP 3 x 64", ("needs=full", "field=classical")),
    Rung("auto, MLP 3 x 64", ("needs=auto", "field=classical")),
    Rung(
        "auto, MLP 2 x 16", ("needs=auto", "field=classical", "color.mlp.layers=2", "color.mlp.width=16"), single=True
    ),
)
CYCLE = 5  # steps between two updates of the proposal networks
BASE = "recipe"  # the trained rung whose weights `SAME_WEIGHTS` render
PAIRS = (
    ("auto", "full"),
    ("auto, MLP 3 x 64", "full, MLP 3 x 64"),
    ("auto", "recipe"),
    ("recipe", "recipe, shading=none"),
)


def scene_overrides(text: str) -> tuple[str, ...]:
    """`poster` or `nerfstudio:DIR` as overrides."""
    name, _, path = text.partition(":")
    return (f"scene={name}", *([f"scene.path={path}"] if path else []))


def configuration(overrides: tuple[str, ...]) -> dict[str, Any]:
    """The composed configuration without Hydra's own part."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = OmegaConf.to_container(compose("config", list(overrides)), resolve=True)
    assert isinstance(config, dict)
    return {str(key): value for key, value in config.items() if key != "hydra"}


@dataclass
class Loaded:
    """A configuration with the trained weights of a run."""

    trainer: Trainer
    evaluator: Evaluator
    parameters: int

    @classmethod
    def of(cls, config: dict[str, Any], run: Path) -> "Loaded":
        _, settings, scene = prepare(config)
        model = build_model(settings, scene)
        table = ray_table(settings, scene)
        watch = Stopwatch(settings.torch_device, model, QuantumLayer)
        checkpoint = torch.load(run / "checkpoint.pt", weights_only=True)
        trainer = Trainer(model, table, settings, watch)
        weights = {
            name: value.to(settings.dtype) if value.is_floating_point() else value
            for name, value in checkpoint["model"].items()
        }
        model.load_state_dict(weights)
        trainer.step = checkpoint["step"]
        evaluator = Evaluator(
            scene, table, model, background=settings.render.background, chunk=settings.train.chunk, watch=watch
        )
        return cls(trainer, evaluator, sum(p.numel() for p in model.parameters()))

    def views(self) -> list[RenderedView]:
        return [self.evaluator.render(view, self.trainer.step) for view in self.evaluator.scene.eval]

    def measured(self, views: list[RenderedView]) -> dict[str, float]:
        rows = pd.DataFrame([self.evaluator.measure(view) for view in views])
        return {key: float(rows[key].astype(float).mean()) for key in ("psnr", "ssim", "depth_error")}


def times(rungs: list[tuple[Rung, Loaded]], rounds: int) -> list[float]:
    """Milliseconds of a training step of each rung: the median over `rounds` cycles of `CYCLE` steps."""

    def cycle(loaded: Loaded) -> None:
        for _ in range(CYCLE):
            loaded.trainer.take_step(measure=False)

    cycles = [partial(cycle, loaded) for _, loaded in rungs]
    seconds = in_turn(cycles, [rung.context for rung, _ in rungs], rounds, warm=1)
    return [1e3 * median(each) / CYCLE for each in seconds]


def same_weights(scene: tuple[str, ...], run: Path, common: tuple[str, ...], rounds: int) -> list[dict[str, Any]]:
    """A row per rung of `SAME_WEIGHTS`; image_error is the root mean square error of a colour channel."""
    rows, reference, loaded = [], None, []
    for rung in SAME_WEIGHTS:
        one = Loaded.of(configuration((*scene, *common, *rung.overrides)), run)
        with rung.context:
            views = one.views()
        pictures = torch.stack([view.color.double() for view in views])
        reference = pictures if reference is None else reference
        error = (pictures - reference).abs()
        rows.append(
            {"kind": "same weights", "rung": rung.name, "parameters": one.parameters, **one.measured(views)}
            | {"image_error": float(error.square().mean().sqrt()), "image_error_max": float(error.max())}
        )
        loaded.append((rung, one))
    for row, step in zip(rows, times(loaded, rounds), strict=True):
        row["step_ms"] = step
    return rows


def trained(
    scene: tuple[str, ...], store: str, common: tuple[str, ...], seeds: list[int], rounds: int
) -> tuple[list[dict[str, Any]], Path]:
    """A row per seed of each rung of `TRAINED`, and the run of `BASE` with the first seed."""
    rows, first, base = [], [], None
    for rung in TRAINED:
        if rung.plain and scene != scene_overrides("poster"):
            continue
        for seed in seeds[:1] if rung.single else seeds:
            # A run's id does not tell how it was computed, so runs on the plain references need a store of their own.
            folder = f"{store}-plain" if rung.plain else store
            config = configuration((*scene, *common, *rung.overrides, f"seed={seed}", f"store={folder}"))
            with rung.context:
                outcome = experiment.run(config, (*scene, *common, *rung.overrides))
            if outcome.state != "finished":
                raise ValueError(f"{outcome.run_id}: {outcome.message}")
            keys = ("psnr", "ssim", "depth_error", "train_s")
            row = {"kind": "trained", "rung": rung.name, "seed": seed, "run": str(outcome.path)}
            rows.append(row | {key: outcome.summary[key] for key in keys})
            rows[-1]["parameters"] = outcome.summary["params.total"]
            print(f"{rung.name:<24} seed {seed}  {rows[-1]['psnr']:.2f} dB", flush=True)
            if seed == seeds[0]:
                first.append((rung, Loaded.of(config, outcome.path)))
                base = outcome.path if rung.name == BASE else base
    steps = dict(zip((rung.name for rung, _ in first), times(first, rounds), strict=True))
    for row in rows:
        row["step_ms"] = steps[str(row["rung"])]
    assert base is not None
    return rows, base


def differences(store: str, table: pd.DataFrame) -> pd.DataFrame:
    """Mean paired difference of PSNR (dB) over seeds and held-out views, with its interval, per scene and pair.

    Also the ratios of step times and of numbers of parameters.
    """
    runs = load.runs(store)
    rows = []
    for scene, own in table[table["kind"] == "trained"].groupby("scene", sort=False):
        for rung, reference in PAIRS:
            one, two = (
                statistics.evaluations(runs[runs["path"].isin(own.loc[own["rung"] == name, "run"])])
                for name in (reference, rung)
            )
            difference = statistics.difference(statistics.paired(one, two))
            interval = {} if difference is None else {key: getattr(difference, key) for key in ("mean", "low", "high")}
            steps, sizes = (own.groupby("rung", sort=False)[key].first() for key in ("step_ms", "parameters"))
            rows.append(
                {"rung": rung, "against": reference, "scene": scene}
                | interval
                | {"steps": steps[rung] / steps[reference], "parameters": sizes[rung] / sizes[reference]}
            )
    return pd.DataFrame(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", required=True, help="folder for the trained runs")
    parser.add_argument("--scene", nargs="+", default=["poster"], help="poster, nerfstudio:DIR, blender:DIR")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--rounds", type=int, default=8, help="measured cycles of five steps per rung")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--overrides", nargs="+", default=[], help="overrides of the configuration for all rungs")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    common = ("field=qcolor", f"train.steps={options.steps}", f"threads={options.threads}", *options.overrides)
    tables = []
    for text in options.scene:
        scene = scene_overrides(text)
        rows, base = trained(scene, options.store, common, options.seeds, options.rounds)
        rows += same_weights(scene, base, (*common, "shading=none"), options.rounds)
        name = Path(text.partition(":")[2] or text).name
        tables.append(pd.DataFrame(rows).assign(scene=name, steps=options.steps))
        print(summary(tables[-1]).to_string(index=False, float_format=lambda value: f"{value:.4g}"), flush=True)
    table = pd.concat(tables, ignore_index=True).assign(threads=options.threads, load=os.getloadavg()[0])
    RESULTS.parent.mkdir(exist_ok=True)
    table.drop(columns="run").to_parquet(RESULTS, index=False)
    paired = differences(options.store, table)
    paired.to_parquet(DIFFERENCES, index=False)
    print(paired.to_string(index=False, float_format=lambda value: f"{value:+.3f}"))
    print(f"saved to {RESULTS} and {DIFFERENCES}")


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """A row per rung: means over its seeds, and the standard deviation of PSNR."""
    keys = ["step_ms", "train_s", "psnr", "ssim", "depth_error", "image_error", "image_error_max", "parameters"]
    groups = table.groupby(["scene", "kind", "rung"], sort=False)
    means = groups[[key for key in keys if key in table]].mean()
    means.insert(2, "psnr_std", groups["psnr"].std())
    return means.assign(seeds=groups.size()).reset_index().replace({np.nan: None})


if __name__ == "__main__":
    main()
