"""Checks and times circuits and training on a GPU: `python -m benchmarks.gpu`.

Prints, and saves as benchmarks/results/gpu.parquet with the card's name:

- error: each head in float32 on the card against float64 on the CPU, outputs and gradients, as a share of the largest;
- layer: milliseconds, forward and backward, and peak memory of QIREN, 6 to 12 wires, 10^3 to 10^6 samples;
- captured: how far a training whose steps are recorded (run.capture=true) ends from a plain one, in float64, as a share
  of the largest parameter; NaN where steps could not be recorded;
- step: milliseconds of a training step on `poster`, for 256 and 4,096 rays, plain and recorded;
- seeds: milliseconds in which one training, or ten side by side, take a recorded step;
- training: seconds of 500 steps, and the PSNR of a held-out view after them, plain and recorded.

It ends after `--minutes`; rows that it did not come to are not saved.
"""

import argparse
import copy
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from functools import partial
from itertools import chain, product
from pathlib import Path
from statistics import median

import pandas as pd
import torch
from torch import Tensor, nn

from benchmarks.training import Row, build, processor
from qnerf.heads import HEADS
from qnerf.kernels import dispatch
from qnerf.quantum import QuantumLayer
from qnerf.training.captured import NAME
from qnerf.training.turns import Turns

RESULTS = Path(__file__).parent / "results" / "gpu.parquet"
STEPS = 500
BEFORE = 50  # steps after which all kinds of steps are recorded
FIELDS = ("classical", "qcolor", "qdensity", "qboth")
CAPTURE = ("run.capture=false", "run.capture=true")


def errors(device: torch.device) -> Iterator[Row]:
    for name in HEADS.names():
        torch.manual_seed(0)
        head = HEADS.build(name, 15, 3)
        features = torch.randn(512, 15)
        exact = _values(copy.deepcopy(head).double(), features.double())
        found = _values(head.to(device), features.to(device))
        worst = max(
            float((own.cpu().double() - true).abs().max() / true.abs().max().clamp(min=1e-6))
            for own, true in zip(found, exact, strict=True)
        )
        yield {"kind": "error", "name": name, "error": worst}


def _values(head: nn.Module, features: Tensor) -> list[Tensor]:
    """Outputs, and gradients of a weighted sum of them by the features and the parameters."""
    inputs = features.detach().requires_grad_()
    out = head(inputs)
    weights = torch.linspace(-1, 1, out.numel(), dtype=torch.float64).view(out.shape).to(out)
    parameters = [one for one in head.parameters() if one.requires_grad]
    gradients = torch.autograd.grad((weights * out).sum(), [inputs, *parameters], allow_unused=True)
    return [out.detach(), *(one for one in gradients if one is not None)]


def layers(device: torch.device, repeats: int) -> Iterator[Row]:
    for wires in (6, 8, 10, 12):
        for spectral in (1, 2):
            layer = QuantumLayer(wires, spectral).to(device)
            for samples in (10**3, 6144, 10**5, 10**6):
                x = torch.randn(samples, wires, device=device, requires_grad=True)
                name = f"{wires} wires, S = {spectral}, {samples} samples"
                yield {"kind": "layer", "name": name, **_timed(partial(_differentiate, layer, x), device, repeats)}


def _differentiate(layer: nn.Module, x: Tensor) -> None:
    layer(x).sum().backward()


def captured(device: torch.device) -> Iterator[Row]:
    for field in FIELDS:
        ends = []
        with dispatch.report() as aside:
            for capture in CAPTURE:
                options = (
                    f"field={field} {capture} sampler.anneal_steps=0 sampler.update_every=2 numerics.dtype=float64"
                )
                trainer, _ = build(f"{options} device={device}")
                for _ in range(BEFORE + 20):
                    trainer.take_step(measure=False)
                ends.append(torch.cat([one.detach().flatten() for one in trainer.model.parameters()]))
        plain, recorded = ends
        worst = float((plain - recorded).abs().max() / plain.abs().max()) if trainer.graphs.recorded else float("nan")
        yield {"kind": "captured", "name": f"field={field} {aside.get(NAME, '')}".strip(), "error": worst}


def steps(device: torch.device, repeats: int) -> Iterator[Row]:
    for field, rays, capture in product(FIELDS, (256, 4096), CAPTURE):
        name = f"field={field} train.rays={rays} {capture}"
        trainer, _ = build(f"{name} sampler.anneal_steps=0 device={device}")
        for _ in range(BEFORE):
            trainer.take_step(measure=False)
        yield {"kind": "step", "name": name, **_timed(partial(trainer.take_step, measure=False), device, repeats)}


def seeds(device: torch.device, repeats: int) -> Iterator[Row]:
    for field, count in product(("classical", "qcolor"), (1, 10)):
        options = f"field={field} run.capture=true sampler.anneal_steps=0 device={device}"
        turns = Turns([partial(_endless, f"{options} seed={seed}") for seed in range(count)], device)
        with closing(turns):
            for _ in range(BEFORE):
                turns.round()
            row = {"kind": "seeds", "name": f"field={field}, {count}", **_timed(turns.round, device, repeats)}
        for error in turns.results():
            raise error
        yield row


def _endless(options: str, aside: dict[str, str]) -> Generator[bool, None, None]:
    trainer, _ = build(options)
    while True:
        trainer.take_step(measure=False)
        yield trainer.replayed


def trainings(device: torch.device) -> Iterator[Row]:
    for field, capture in product(("classical", "qcolor"), CAPTURE):
        trainer, evaluator = build(
            f"field={field} {capture} train.steps={STEPS} sampler.anneal_steps=100 device={device}"
        )
        start = time.perf_counter()
        for number in range(STEPS):
            trainer.take_step(measure=number == STEPS - 1)
        seconds = time.perf_counter() - start
        view = evaluator.scene.eval[0]
        psnr = evaluator.measure(evaluator.render(view, trainer.step))["psnr"]
        yield {"kind": "training", "name": f"field={field} {capture}", "ms": 1e3 * seconds, "psnr": psnr}


def _timed(call: Callable[[], object], device: torch.device, repeats: int) -> Row:
    """Median milliseconds after two calls that do not count, and peak bytes; NaN where memory does not suffice."""
    times = []
    try:
        for number in range(repeats + 2):
            _wait(device)
            if device.type == "cuda" and number == 2:
                torch.cuda.reset_peak_memory_stats(device)
            start = time.perf_counter()
            call()
            _wait(device)
            times.append(time.perf_counter() - start)
    except torch.OutOfMemoryError:
        return {"ms": float("nan")}
    peak = torch.cuda.max_memory_allocated(device) if device.type == "cuda" else 0
    return {"ms": 1e3 * median(times[2:]), "peak_bytes": peak}


def _wait(device: torch.device) -> None:
    if device.type != "cpu":
        torch.accelerator.synchronize(device)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", help="default: the accelerator that PyTorch sees")
    parser.add_argument("--minutes", type=float, default=8.0)
    parser.add_argument("--repeats", type=int, default=10, help="of each call (default 10)")
    options = parser.parse_args()
    found = torch.accelerator.current_accelerator()
    if options.device is None and found is None:
        parser.error("PyTorch sees no GPU; --device cpu tries the command without one, and saves nothing")
    device = torch.device(options.device or found)
    card = torch.cuda.get_device_name(device) if device.type == "cuda" else f"{device}, {processor()}"
    end, rows = time.monotonic() + 60 * options.minutes, []
    repeats = options.repeats
    timed = steps(device, repeats), seeds(device, repeats), trainings(device), layers(device, repeats)
    for row in chain(errors(device), captured(device), *timed):
        rows.append(row | {"card": card, "torch": torch.__version__})
        shown = ("error", "ms", "peak_bytes", "psnr")
        print(row["kind"], row["name"], *(f"{key} {row[key]:.4g}" for key in shown if key in row), flush=True)
        if time.monotonic() > end:
            print(f"stopped after {options.minutes:g} minutes")
            break
    if device.type != "cpu":
        pd.DataFrame(rows).to_parquet(RESULTS, index=False)


if __name__ == "__main__":
    main()
