"""Measures a whole training step, stage by stage: `python -m benchmarks.training`.

Prints, and saves as benchmarks/results/training.parquet:

- steps: every field x encoder x circuit, median milliseconds of a step and of each stage, beside the minimum work of
  the step (operations, bytes) and how fast this machine does such work (a matrix product, a copy);
- ratios that the project promises, with both sides measured alternately: compiled loops against their plain PyTorch
  references, circuits against the classical head and against PennyLane, evaluation against training;
- tables: the hash tables C1 to C7, whose cost grows with their size, and the paper's recipe;
- sizes: steps with other numbers of rays and of samples on a ray.

Rows of the file that are not measured again stay.
"""

import argparse
import os
import platform
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from statistics import median

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import pandas as pd
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

import qnerf.cli.resolvers  # noqa: F401  the configuration needs them
from qnerf import kernels
from qnerf.building.model import build_model, ray_table
from qnerf.building.scene import prepare
from qnerf.config.folders import CONF
from qnerf.encoders import HashEncoder
from qnerf.quantum import QuantumLayer
from qnerf.timing import STAGES, Stopwatch
from qnerf.training.evaluation import Evaluator
from qnerf.training.trainer import Trainer

RESULTS = Path(__file__).parent / "results" / "training.parquet"
FIELDS = ("classical", "qcolor", "qdensity", "qboth")
ENCODERS = ("hash", "pe", "rff", "none")
CIRCUITS = tuple(f"{layers}L{spectral}S" for layers in range(1, 5) for spectral in range(1, 5))
NO_SHADING = "shading=none"
RAW = "field=classical color.directions=raw color.mlp.init=he"
RATIOS = {  # name -> overrides of the numerator, overrides of the denominator, promise
    "plain references / compiled, classical C5": (
        f"field=classical {NO_SHADING}",
        f"field=classical {NO_SHADING}",
        "at least 4",
    ),
    **{
        f"{name} / classical, no gate": (
            f"field=qcolor qiren={name} {NO_SHADING}",
            f"field=classical {NO_SHADING}",
            promised,
        )
        for name, promised in (("1L1S", "at most 1.25"), ("1L2S", "at most 1.8"), ("3L4S", ""))
    },
    **{
        f"{name} / classical, shading=merge": (f"field=qcolor qiren={name}", "field=classical", promised)
        for name, promised in (("1L1S", ""), ("1L2S", "at most 1.3"), ("3L4S", "at most 2.0"))
    },
    **{f"{field} 1L2S / classical with raw directions, shading=merge": (f"field={field}", RAW, "") for field in FIELDS},
    **{
        f"PennyLane / qnerf, {name}, no gate": (
            f"field=qcolor qiren={name} qiren.method=pennylane {NO_SHADING}",
            f"field=qcolor qiren={name} {NO_SHADING}",
            "at least 40",
        )
        for name in ("1L1S", "1L2S")
    },
}

SIZES = (
    *(f"field=classical train.rays={rays}" for rays in (64, 128, 256, 512, 1024)),
    "field=classical proposal.samples=[128,64]",
    "field=classical proposal.final=64",
    "field=classical proposal.samples=[128,64] proposal.final=64",
)


def build(overrides: str) -> tuple[Trainer, Evaluator]:
    """A trainer on the built-in scene with the quick recipe, and an evaluator of its views."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = OmegaConf.to_container(compose("config", overrides.split()), resolve=True)
    assert isinstance(config, dict)
    _, settings, scene = prepare({str(key): value for key, value in config.items() if key != "hydra"})
    model = build_model(settings, scene)
    table = ray_table(settings, scene)
    watch = Stopwatch(settings.torch_device, model, QuantumLayer)
    evaluator = Evaluator(
        scene, table, model, background=settings.render.background, chunk=settings.train.chunk, watch=watch
    )
    return Trainer(model, table, settings, watch), evaluator


def in_turn(
    steps: Sequence[Callable[[], object]],
    contexts: Sequence[AbstractContextManager[None]],
    rounds: int,
    warm: int,
) -> list[list[float]]:
    """Seconds of each step function: they run alternately, `rounds` times after `warm` uncounted rounds."""
    times: list[list[float]] = [[] for _ in steps]
    for count in range(warm + rounds):
        for step, context, seconds in zip(steps, contexts, times, strict=True):
            with context:
                start = time.perf_counter()
                step()
                if count >= warm:
                    seconds.append(time.perf_counter() - start)
    return times


class Plain(AbstractContextManager[None]):
    """A reusable `kernels.plain`."""

    def __enter__(self) -> None:
        self.inside = kernels.plain()
        self.inside.__enter__()

    def __exit__(self, *error: object) -> None:
        self.inside.__exit__(None, None, None)


def minimum_work(trainer: Trainer) -> dict[str, float]:
    """Operations and bytes that a step needs at least, forward and backward: the heads' matrix products, reads and
    gradients of hash table entries, optimiser traffic."""
    samples = trainer.train.rays * getattr(trainer.model.sampler, "final", 0)
    field = trainer.model.field
    layers = [layer for head in (field.density_head, field.color_head) for layer in head.modules()]
    products = [layer.weight for layer in layers if isinstance(layer, torch.nn.Linear)]
    table = field.encoder.table.numel() if isinstance(field.encoder, HashEncoder) else 0
    entries = 8 * field.encoder.out_dim if isinstance(field.encoder, HashEncoder) else 0
    parameters = sum(p.numel() for p in trainer.model.parameters())
    return {
        "head_gflop": 6e-9 * samples * sum(weight.numel() for weight in products),
        "lookup_mb": 4e-6 * samples * entries * 3,  # reads of the table, reads and writes of its gradient
        "optimiser_mb": 4e-6 * parameters * 7,  # reads of gradient, parameter, two moments; writes of the last three
        "table_entries": table,
        "samples": samples,
    }


def machine() -> dict[str, float]:
    """Speed of this machine: float32 GFLOP/s of a large product, GB/s of a copy (reads plus writes)."""
    square, long = torch.randn(1536, 1536), torch.randn(2**25)
    target = torch.empty_like(long)
    products, copies = in_turn(
        [lambda: square @ square, lambda: target.copy_(long)], [nullcontext()] * 2, rounds=7, warm=2
    )
    return {"gflops": 2e-9 * 1536**3 / median(products), "gbs": 2e-9 * long.nbytes / median(copies)}


def profile(overrides: str, rounds: int, limits: dict[str, float]) -> dict[str, object]:
    """A row of kind `step`; `floor_ms` is the time of the minimum work at the machine's speed."""
    trainer, _ = build(overrides)
    for _ in range(15):
        trainer.take_step(measure=False)
    logged = pd.DataFrame([trainer.take_step(measure=True) for _ in range(rounds)])
    needed = minimum_work(trainer)
    floor = needed["head_gflop"] / limits["gflops"] + 1e-3 * needed["optimiser_mb"] / limits["gbs"]
    return {
        "kind": "step",
        "name": overrides,
        "ms": logged["time/step_ms"].median(),
        **{f"{stage}_ms": logged[f"time/{stage}_ms"].median() for stage in STAGES},
        "parameters": sum(p.numel() for p in trainer.model.parameters()),
        **needed,
        "floor_ms": 1e3 * floor,
    }


def ratio(name: str, rounds: int) -> dict[str, object]:
    """A row of kind `ratio`: milliseconds a step of both sides."""
    above, below, promised = RATIOS[name]
    slow = "PennyLane" in name
    contexts: list[AbstractContextManager[None]] = [nullcontext(), nullcontext()]
    if name.startswith("plain"):
        contexts[0] = Plain()
    (first, _), (second, _) = build(above), build(below)
    for _ in range(30):
        second.take_step(measure=False)
    times = in_turn(
        [lambda: first.take_step(measure=False), lambda: second.take_step(measure=False)],
        contexts,
        rounds=3 if slow else rounds,
        warm=1 if slow else 5,
    )
    numerator, denominator = (1e3 * median(seconds) for seconds in times)
    row = {"kind": "ratio", "name": name, "above_ms": numerator, "below_ms": denominator}
    return row | {"ratio": numerator / denominator, "promised": promised}


def evaluation(overrides: str, rounds: int) -> dict[str, object]:
    """A row of kind `ratio`: microseconds per ray of rendering a held-out view, and of a training step."""
    trainer, evaluator = build(overrides)
    for _ in range(30):
        trainer.take_step(measure=False)
    view = evaluator.scene.eval[0]
    rendered, stepped = in_turn(
        [lambda: evaluator.render(view, trainer.step), lambda: trainer.take_step(measure=False)],
        [nullcontext()] * 2,
        rounds=max(rounds // 4, 3),
        warm=1,
    )
    above, below = 1e6 * median(rendered) / len(trainer.table.view(view)), 1e6 * median(stepped) / trainer.train.rays
    name = f"evaluation / training, microseconds a ray, {overrides}"
    row = {"kind": "ratio", "name": name, "above_ms": above / 1e3, "below_ms": below / 1e3}
    return row | {"ratio": above / below, "promised": "at most 1"}


def with_old_rows(frame: pd.DataFrame) -> pd.DataFrame:
    """`frame`, and the rows of the file that were not measured again."""
    if not RESULTS.exists():
        return frame
    old = pd.read_parquet(RESULTS)
    key = ["name", "threads"]
    again = old.set_index(key).index.isin(frame.set_index(key).index)
    return pd.concat([old[~again], frame], ignore_index=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=40, help="measured steps a row and a ratio (default 40)")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument(
        "--only",
        choices=["steps", "ratios", "tables", "sizes"],
        nargs="+",
        default=["steps", "ratios", "tables", "sizes"],
    )
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    limits = machine()
    print(f"{platform.machine()}, {options.threads} threads: {limits['gflops']:.0f} GFLOP/s, {limits['gbs']:.1f} GB/s")
    rows: list[dict[str, object]] = []
    if "steps" in options.only:
        for encoder in ENCODERS:
            for field in FIELDS:
                for circuit in CIRCUITS[:1] if field == "classical" else CIRCUITS:
                    overrides = f"field={field} encoder={encoder} qiren={circuit}"
                    rows.append(profile(overrides, options.rounds, limits))
                    print(f"{overrides:<48} {rows[-1]['ms']:8.2f} ms", flush=True)
    if "tables" in options.only:
        tables = [f"field=classical hash=C{number}" for number in range(1, 8)]
        for overrides in (*tables, "train=paper field=classical", "train=paper field=qcolor"):
            rows.append(profile(overrides, options.rounds, limits))
            print(f"{overrides:<48} {rows[-1]['ms']:8.2f} ms", flush=True)
    if "sizes" in options.only:
        for overrides in SIZES:
            rows.append(profile(overrides, options.rounds, limits))
            print(f"{overrides:<64} {rows[-1]['ms']:8.2f} ms", flush=True)
    if "ratios" in options.only:
        for name in RATIOS:
            rows.append(ratio(name, options.rounds))
            print(f"{name:<64} {rows[-1]['ratio']:8.2f}  {rows[-1]['promised']}", flush=True)
        for overrides in ("field=classical", "field=qcolor"):
            rows.append(evaluation(overrides, options.rounds))
            print(f"{rows[-1]['name']:<64} {rows[-1]['ratio']:8.2f}  {rows[-1]['promised']}", flush=True)
    frame = pd.DataFrame(rows).assign(threads=options.threads, **limits)
    columns = ["name", "ms", *(f"{stage}_ms" for stage in STAGES), "parameters", "floor_ms"]
    if "ms" in frame:
        print(frame[frame["kind"] == "step"][columns].round(2).to_string(index=False))
    RESULTS.parent.mkdir(exist_ok=True)
    with_old_rows(frame).to_parquet(RESULTS, index=False)
    print(f"medians of {options.rounds}; saved to {RESULTS}")


if __name__ == "__main__":
    main()
