"""Measures a training step and its parts: `python -m benchmarks.training`.

Prints, and saves as benchmarks/results/training.parquet:

- steps: median milliseconds of a step and of each stage, for each field, each hash table, the paper's recipe, and
  differing numbers of rays and samples;
- ratios, with both sides measured in turns: compiled loops against their plain PyTorch references, circuits against
  the classical head and against PennyLane, evaluation against training.

Each row names the processor, and the bytes of the vectors that circuits use on it.
"""

import argparse
import os
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from itertools import chain
from pathlib import Path
from statistics import median

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import pandas as pd
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from qnerf import kernels
from qnerf.building.model import build_model, ray_table
from qnerf.building.scene import prepare
from qnerf.cli.resolvers import HYDRA
from qnerf.config.folders import CONF
from qnerf.kernels.simd import VECTOR_BYTES
from qnerf.quantum import QuantumLayer
from qnerf.timing import STAGES, Stopwatch
from qnerf.training.evaluation import Evaluator
from qnerf.training.trainer import Trainer

RESULTS = Path(__file__).parent / "results" / "training.parquet"
FIELDS = ("classical", "qcolor", "qdensity", "qboth")
CIRCUITS = ("1L1S", "1L2S", "3L4S")
NO_SHADING = "shading=none"
RAW = "field=classical color.directions=raw color.mlp.init=he"
SIZES = ("train.rays=64", "train.rays=256", "train.rays=1024", "proposal.samples=[128,64]", "proposal.final=64")
STEPS = (
    *(f"field={field}" for field in FIELDS),
    *(f"field=classical hash=C{number}" for number in range(1, 8)),
    "train=paper field=classical",
    "train=paper field=qcolor",
    *(f"field=classical {sizes}" for sizes in SIZES),
)
RATIOS = {  # name -> overrides of the numerator, overrides of the denominator
    "plain references / compiled, classical C5": (f"field=classical {NO_SHADING}", f"field=classical {NO_SHADING}"),
    **{
        f"{name} / classical, {shading}": (f"field=qcolor qiren={name} {shading}", f"field=classical {shading}")
        for shading in (NO_SHADING, "shading=merge")
        for name in CIRCUITS
    },
    **{f"{field} 1L2S / classical with raw directions, shading=merge": (f"field={field}", RAW) for field in FIELDS},
    **{
        f"PennyLane / qnerf, {name}, shading=none": (
            f"field=qcolor qiren={name} qiren.method=pennylane {NO_SHADING}",
            f"field=qcolor qiren={name} {NO_SHADING}",
        )
        for name in CIRCUITS[:2]
    },
}
Row = dict[str, object]


def build(overrides: str) -> tuple[Trainer, Evaluator]:
    """A trainer of the configuration with these overrides, and an evaluator of its held-out views."""
    with initialize_config_dir(str(CONF), **HYDRA):
        config = OmegaConf.to_container(compose("config", overrides.split()), resolve=True)
    assert isinstance(config, dict)
    settings, scene = prepare({str(key): value for key, value in config.items() if key != "hydra"}).of_field()
    model = build_model(settings, scene)
    table = ray_table(settings, scene)
    watch = Stopwatch(settings.torch_device, model, QuantumLayer)
    evaluator = Evaluator(
        scene, table, model, background=settings.render.background, chunk=settings.train.chunk, watch=watch
    )
    return Trainer(model, table, settings, watch), evaluator


def in_turn(
    steps: Sequence[Callable[[], object]],
    contexts: Sequence[Callable[[], AbstractContextManager[None]]],
    rounds: int,
    block: int,
) -> list[float]:
    """Median seconds of each step function. They run in turns, `rounds` times after a round that does not count.

    A turn is `block` steps after one that does not count, because the other function has filled the caches.
    """
    times: list[list[float]] = [[] for _ in steps]
    for count in range(1 + rounds):
        for step, context, seconds in zip(steps, contexts, times, strict=True):
            with context():
                step()
                for _ in range(block):
                    start = time.perf_counter()
                    step()
                    if count:
                        seconds.append(time.perf_counter() - start)
    return [median(seconds) for seconds in times]


def warmed(overrides: str) -> tuple[Trainer, Evaluator]:
    """As `build`, after the steps that compile."""
    trainer, evaluator = build(overrides)
    for _ in range(30):
        trainer.take_step(measure=False)
    return trainer, evaluator


def steps(rounds: int) -> Iterator[Row]:
    """Milliseconds of a step and of each stage."""
    for overrides in STEPS:
        trainer, _ = warmed(overrides)
        logged = pd.DataFrame([trainer.take_step(measure=True) for _ in range(rounds)])
        yield {
            "kind": "step",
            "name": overrides,
            "ms": logged["time/step_ms"].median(),
            **{f"{stage}_ms": logged[f"time/{stage}_ms"].median() for stage in STAGES},
            "parameters": sum(p.numel() for p in trainer.model.parameters()),
        }


def ratios(rounds: int) -> Iterator[Row]:
    """Milliseconds of a step of both sides; of evaluation and training, of a ray."""
    for name, (above, below) in RATIOS.items():
        slow = "PennyLane" in name
        first, second = build(above)[0], warmed(below)[0]
        contexts = [kernels.plain if name.startswith("plain") else nullcontext, nullcontext]
        sides = [partial(trainer.take_step, measure=False) for trainer in (first, second)]
        pair = in_turn(sides, contexts, rounds=3 if slow else max(rounds // 4, 3), block=2 if slow else 5)
        yield ratio(name, *pair)
    for overrides in ("field=classical", "field=qcolor"):
        trainer, evaluator = warmed(overrides)
        view = evaluator.scene.eval[0]
        functions: list[Callable[[], object]] = [
            partial(evaluator.render, view, trainer.step),
            partial(trainer.take_step, measure=False),
        ]
        image, step = in_turn(functions, [nullcontext] * 2, rounds=max(rounds // 4, 3), block=5)
        rays = len(trainer.table.view(view)), trainer.train.rays
        name = f"evaluation / training, microseconds a ray, {overrides}"
        yield ratio(name, image / rays[0], step / rays[1])


def ratio(name: str, above: float, below: float) -> Row:
    """A row from seconds."""
    return {"kind": "ratio", "name": name, "above_ms": 1e3 * above, "below_ms": 1e3 * below, "ratio": above / below}


def processor() -> str:
    """Name, family and model where Linux says so."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    about = dict(reversed([[part.strip() for part in line.split(":", 1)] for line in lines if ":" in line]))
    return f"{about.get('model name')}, family {about.get('cpu family')} model {about.get('model')}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=40, help="measured steps a row and a ratio (default 40)")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    options = parser.parse_args()
    rows = []
    for threads in options.threads:
        torch.set_num_threads(threads)
        for row in chain(steps(options.rounds), ratios(options.rounds)):
            rows.append(row | {"threads": threads, "processor": processor(), "vector_bytes": VECTOR_BYTES})
            print(f"{threads} {row['name']:<76} {row.get('ratio', row.get('ms')):8.2f}", flush=True)
    pd.DataFrame(rows).to_parquet(RESULTS, index=False)
    print(f"milliseconds, or ratios; medians of {options.rounds}; saved to {RESULTS}")


if __name__ == "__main__":
    main()
