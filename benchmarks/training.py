"""Measures a whole training step, stage by stage: `python -m benchmarks.training`.

Prints, and saves as benchmarks/results/training.parquet:

- steps: every field x encoder x circuit, median milliseconds of a step and of each stage, beside the minimum work of
  the step (operations, bytes) and how fast this machine does such work (a matrix product, a copy);
- ratios, with both sides measured alternately: compiled loops against their plain PyTorch references, circuits against
  the classical head and against PennyLane, evaluation against training;
- tables: the hash tables C1 to C7, whose cost grows with their size, and the paper's recipe;
- sizes: steps with other numbers of rays and of samples on a ray;
- operations: what a step spends its time on, as PyTorch's profiler counts it.

Rows of the file that are not measured again stay.
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
RATIOS = {  # name -> overrides of the numerator, overrides of the denominator
    "plain references / compiled, classical C5": (f"field=classical {NO_SHADING}", f"field=classical {NO_SHADING}"),
    **{
        f"{name} / classical, shading=none": (
            f"field=qcolor qiren={name} {NO_SHADING}",
            f"field=classical {NO_SHADING}",
        )
        for name in ("1L1S", "1L2S", "3L4S")
    },
    **{
        f"{name} / classical, shading=merge": (f"field=qcolor qiren={name}", "field=classical")
        for name in ("1L1S", "1L2S", "3L4S")
    },
    **{f"{field} 1L2S / classical with raw directions, shading=merge": (f"field={field}", RAW) for field in FIELDS},
    **{
        f"PennyLane / qnerf, {name}, shading=none": (
            f"field=qcolor qiren={name} qiren.method=pennylane {NO_SHADING}",
            f"field=qcolor qiren={name} {NO_SHADING}",
        )
        for name in ("1L1S", "1L2S")
    },
}

PROFILED = ("field=classical", "train=paper field=classical", "field=qcolor", "field=qdensity")
OPERATIONS = {  # group -> the start of its operations' names in PyTorch's profiler
    "hash grids and the MLPs on them": ("_GridMLP", "_HashEncode"),
    "other linear layers and ReLU": ("aten::mm", "aten::addmm", "aten::linear", "aten::relu", "aten::threshold"),
    "circuits": ("_Polynomials", "_Simulate", "NormalisedForms", "_WithoutGradient"),
    "weights, regularisers, merging": ("_VolumeWeights", "Distortion", "Interlevel", "Merge"),
    "Adam": ("aten::_fused_adam", "Optimizer", "aten::_foreach"),
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
    block: int = 1,
) -> list[list[float]]:
    """Seconds of each step function: they run alternately, `rounds` times after `warm` uncounted rounds.

    With a block of several, each turn is that many steps after an uncounted one, because the other function has filled
    the caches.
    """
    times: list[list[float]] = [[] for _ in steps]
    for count in range(warm + rounds):
        for step, context, seconds in zip(steps, contexts, times, strict=True):
            with context:
                if block > 1:
                    step()
                for _ in range(block):
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


def operations(overrides: str, rounds: int) -> list[dict[str, object]]:
    """Rows of kind `operation`: milliseconds and operations a step of each group, as PyTorch's profiler sees them.

    The profiler slows a step down, small operations most of all. What it does not see is Python, and the loops that
    have no gradient: points, and edges drawn from a histogram.
    """
    trainer, _ = build(overrides)
    for _ in range(30):
        trainer.take_step(measure=False)
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profiler:
        for _ in range(rounds):
            trainer.take_step(measure=False)
    groups = {name: [0.0, 0.0] for name in (*OPERATIONS, "other operations of PyTorch")}
    for event in profiler.key_averages():
        found = [name for name, starts in OPERATIONS.items() if event.key.startswith(starts)]
        group = groups[found[0] if found else "other operations of PyTorch"]
        group[0] += event.self_cpu_time_total / 1e3 / rounds
        group[1] += event.count / rounds
    whole = 1e3 * sum(trainer.step_seconds[-rounds:]) / rounds
    seen = sum(ms for ms, _ in groups.values())
    groups["Python, and loops without a gradient"] = [whole - seen, 0.0]
    return [
        {"kind": "operation", "name": f"{overrides}: {name}", "ms": ms, "share": ms / whole, "calls": calls}
        for name, (ms, calls) in groups.items()
        if ms
    ]


def ratio(name: str, rounds: int) -> dict[str, object]:
    """A row of kind `ratio`: milliseconds a step of both sides."""
    above, below = RATIOS[name]
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
        rounds=3 if slow else max(rounds // 4, 3),
        warm=1,
        block=2 if slow else 5,
    )
    numerator, denominator = (1e3 * median(seconds) for seconds in times)
    row = {"kind": "ratio", "name": name, "above_ms": numerator, "below_ms": denominator}
    return row | {"ratio": numerator / denominator}


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
        block=5,
    )
    above, below = 1e6 * median(rendered) / len(trainer.table.view(view)), 1e6 * median(stepped) / trainer.train.rays
    name = f"evaluation / training, microseconds a ray, {overrides}"
    row = {"kind": "ratio", "name": name, "above_ms": above / 1e3, "below_ms": below / 1e3}
    return row | {"ratio": above / below}


Rows = Iterator[dict[str, object]]


def steps(names: Sequence[str], rounds: int, limits: dict[str, float]) -> Rows:
    for overrides in names:
        row = profile(overrides, rounds, limits)
        print(f"{overrides:<64} {row['ms']:8.2f} ms", flush=True)
        yield row


def ratios(rounds: int) -> Rows:
    measured = (ratio(name, rounds) for name in RATIOS)
    views = (evaluation(overrides, rounds) for overrides in ("field=classical", "field=qcolor"))
    for row in chain(measured, views):
        print(f"{row['name']:<64} {row['ratio']:8.2f}", flush=True)
        yield row


def all_operations(rounds: int) -> Rows:
    for overrides in PROFILED:
        for row in operations(overrides, rounds):
            print(f"{row['name']:<76} {row['ms']:8.2f} ms {row['calls']:6.0f}", flush=True)
            yield row


MODELS = [
    f"field={field} encoder={encoder} qiren={circuit}"
    for encoder in ENCODERS
    for field in FIELDS
    for circuit in (CIRCUITS[:1] if field == "classical" else CIRCUITS)
]
TABLES = [
    *(f"field=classical hash=C{number}" for number in range(1, 8)),
    "train=paper field=classical",
    "train=paper field=qcolor",
]
PARTS: dict[str, Callable[[int, dict[str, float]], Rows]] = {
    "steps": partial(steps, MODELS),
    "tables": partial(steps, TABLES),
    "sizes": partial(steps, SIZES),
    "ratios": lambda rounds, _: ratios(rounds),
    "operations": lambda rounds, _: all_operations(rounds),
}


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
        choices=list(PARTS),
        nargs="+",
        default=list(PARTS),
    )
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    limits = machine()
    print(f"{platform.machine()}, {options.threads} threads: {limits['gflops']:.0f} GFLOP/s, {limits['gbs']:.1f} GB/s")
    rows = [row for part in options.only for row in PARTS[part](options.rounds, limits)]
    frame = pd.DataFrame(rows).assign(threads=options.threads, **limits)
    columns = ["name", "ms", *(f"{stage}_ms" for stage in STAGES), "parameters", "floor_ms"]
    if "floor_ms" in frame:
        print(frame[frame["kind"] == "step"][columns].round(2).to_string(index=False))
    RESULTS.parent.mkdir(exist_ok=True)
    with_old_rows(frame).to_parquet(RESULTS, index=False)
    print(f"medians of {options.rounds}; saved to {RESULTS}")


if __name__ == "__main__":
    main()
