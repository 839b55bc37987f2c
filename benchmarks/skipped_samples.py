"""What a density circuit could save by samples that the last proposal network calls empty, and what that would cost.

    python -m benchmarks.skipped_samples poster nerfstudio:FOX blender:CHAIR

Trains `field=qdensity` on each scene (SCENE, or KIND:PATH). Then it renders the held-out views without those final
samples whose intervals touch less than a threshold of the last proposal network's weight. Prints for each threshold,
and saves as benchmarks/results/skipped_samples.parquet: the share of evaluated samples that are skipped, held-out PSNR
in dB, and the root mean square difference from the picture with all samples.
"""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pandas as pd
import torch

from benchmarks.training import build
from qnerf.model.model import Model
from qnerf.training.image_metrics import psnr
from qnerf.training.losses import outer_measure

RESULTS = Path(__file__).parent / "results" / "skipped_samples.parquet"
THRESHOLDS = (0.0, 1e-3, 1e-2, 3e-2, 1e-1)


@contextmanager
def skipping(model: Model, threshold: float) -> Iterator[list[tuple[int, int]]]:
    """Inside, skipped samples have no density. Yields a list of (skipped, evaluated) samples of each chunk of rays."""
    counts: list[tuple[int, int]] = []
    sampler, geometry_at = model.sampler.forward, model.field.geometry_at
    last: dict[str, Any] = {}

    def sample(*arguments: Any, **options: Any) -> Any:
        last["sampled"] = sampler(*arguments, **options)
        return last["sampled"]

    def geometry(*arguments: Any, **options: Any) -> Any:
        density, features, evaluated = geometry_at(*arguments, **options)
        proposal, weights = last["sampled"].proposals[-1]
        empty = outer_measure(last["sampled"].samples.spacing, proposal.spacing, weights) < threshold
        known = torch.ones_like(empty) if evaluated is None else evaluated
        counts.append((int((empty & known).sum()), int(known.sum())))
        return density.masked_fill(empty, 0), features, evaluated

    with patch.object(model.sampler, "forward", sample), patch.object(model.field, "geometry_at", geometry):
        yield counts


def measure(scene: str, steps: int) -> list[dict[str, object]]:
    kind, _, path = scene.partition(":")
    source = f"scene={kind}" + (f" scene.path={Path(path).absolute()} scene.skip_missing=true" if path else "")
    trainer, evaluator = build(f"field=qdensity {source} train.steps={steps}")
    while not trainer.done:
        trainer.take_step(measure=False)
    rows: list[dict[str, object]] = []
    whole: dict[int, torch.Tensor] = {}
    for threshold in THRESHOLDS:
        with skipping(trainer.model, threshold) as counts:
            pictures = {view: evaluator.render(view, trainer.step).color for view in evaluator.scene.eval}
        whole = whole or pictures
        skipped, evaluated = map(sum, zip(*counts, strict=True))
        quality = [float(psnr(picture.double(), evaluator.truth(view).double())) for view, picture in pictures.items()]
        difference = torch.cat([(pictures[view] - whole[view]).flatten() for view in pictures]).square().mean().sqrt()
        without = f"below {threshold:g}" if threshold else "nothing"
        row = {"without": without, "skipped": skipped / evaluated, "psnr": sum(quality) / len(quality)}
        rows.append({"scene": Path(path).name or kind, "steps": steps} | row | {"difference": float(difference)})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--steps", type=int, default=1500, help="of training (default 1500)")
    options = parser.parse_args()
    frame = pd.DataFrame([row for scene in options.scenes for row in measure(scene, options.steps)])
    print(frame.to_string(index=False))
    frame.to_parquet(RESULTS, index=False)
    print(f"saved to {RESULTS}")


if __name__ == "__main__":
    main()
