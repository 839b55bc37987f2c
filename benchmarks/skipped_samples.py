"""What a density circuit could save by samples that the last proposal network calls empty, and what that would cost.

    python -m benchmarks.skipped_samples poster nerfstudio:FOX blender:CHAIR

Trains `field=qdensity` on each scene (SCENE, or KIND:PATH), with each seed twice: with all final samples, and without
those whose intervals touch less than 0.01 of the last proposal network's weight. Then it renders the held-out views,
those of the first also with other thresholds. Saves as benchmarks/results/skipped_samples.parquet, and prints as means
over the seeds: the share of samples that are skipped in the pictures, held-out PSNR in dB, the root mean square
difference from the picture with all samples, and of the last quarter of training the median CPU milliseconds a step.
"""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from statistics import median
from time import process_time
from typing import Any
from unittest.mock import patch

import pandas as pd
import torch

from benchmarks.training import build
from qnerf.model.model import Model
from qnerf.training.image_metrics import psnr
from qnerf.training.losses import outer_measure

RESULTS = Path(__file__).parent / "results" / "skipped_samples.parquet"
THRESHOLD = 1e-2  # in training
THRESHOLDS = (0.0, 1e-3, 1e-2, 3e-2, 1e-1)  # in pictures


@contextmanager
def skipping(model: Model, threshold: float) -> Iterator[list[tuple[int, int]]]:
    """Inside, skipped samples are not evaluated. Yields a list of (skipped, all) samples of each chunk of rays."""
    counts: list[tuple[int, int]] = []
    sampler, geometry_at = model.sampler.forward, model.field.geometry_at
    last: dict[str, Any] = {}

    def sample(*arguments: Any, **options: Any) -> Any:
        last["sampled"] = sampler(*arguments, **options)
        return last["sampled"]

    def geometry(unit: torch.Tensor, inside: torch.Tensor | None, **options: Any) -> Any:
        proposal, weights = last["sampled"].proposals[-1]
        full = outer_measure(last["sampled"].samples.spacing, proposal.spacing, weights.detach()) >= threshold
        known = torch.ones_like(full) if inside is None else inside
        counts.append((int((known & ~full).sum()), int(known.sum())))
        return geometry_at(unit, known & full, **options)

    with patch.object(model.sampler, "forward", sample), patch.object(model.field, "geometry_at", geometry):
        yield counts


def measure(scene: str, steps: int, seed: int, skips: bool) -> list[dict[str, object]]:
    """The rows of one training, which skips samples or not."""
    kind, _, path = scene.partition(":")
    source = f"scene={kind}" + (f" scene.path={Path(path).absolute()} scene.skip_missing=true" if path else "")
    trainer, evaluator = build(f"field=qdensity {source} train.steps={steps} seed={seed}")
    times: list[float] = []
    while not trainer.done:
        begun = process_time()
        with skipping(trainer.model, THRESHOLD) if skips else nullcontext():
            trainer.take_step(measure=False)
        times.append(process_time() - begun)
    rows: list[dict[str, object]] = []
    whole: dict[int, torch.Tensor] = {}
    for threshold in (0.0, THRESHOLD) if skips else THRESHOLDS:
        with skipping(trainer.model, threshold) as counts:
            pictures = {view: evaluator.render(view, trainer.step).color for view in evaluator.scene.eval}
        whole = whole or pictures
        skipped, evaluated = map(sum, zip(*counts, strict=True))
        quality = [float(psnr(picture.double(), evaluator.truth(view).double())) for view, picture in pictures.items()]
        difference = torch.cat([(pictures[view] - whole[view]).flatten() for view in pictures]).square().mean().sqrt()
        rows.append(
            {
                "scene": Path(path).name or kind,
                "trained": f"without those below {THRESHOLD:g}" if skips else "with all samples",
                "without": f"below {threshold:g}" if threshold else "nothing",
                "steps": steps,
                "seed": seed,
                "skipped": skipped / evaluated,
                "psnr": sum(quality) / len(quality),
                "difference": float(difference),
                "ms": 1000 * median(times[-steps // 4 :]),
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--steps", type=int, default=1500, help="of training (default 1500)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    options = parser.parse_args()
    cases = [(scene, seed, skips) for seed in options.seeds for scene in options.scenes for skips in (False, True)]
    frame = pd.DataFrame([row for scene, seed, skips in cases for row in measure(scene, options.steps, seed, skips)])
    frame.to_parquet(RESULTS, index=False)
    print(frame.groupby(["scene", "trained", "without"], sort=False)[["skipped", "psnr", "difference", "ms"]].mean())
    print(f"saved to {RESULTS}")


if __name__ == "__main__":
    main()
