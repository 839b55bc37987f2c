"""A trained run rendered as on hardware: with finitely many shots, or with noisy gates."""

import itertools
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields

import pandas as pd
import torch
from torch import Tensor

from qnerf.config.checks import at_least
from qnerf.metrics import image_metrics, metric_of
from qnerf.probes.trained import Trained
from qnerf.quantum import QuantumLayer, hardware_conditions
from qnerf.quantum.pennylane import Noise
from qnerf.records.files import exists, replace
from qnerf.records.read import read_probe
from qnerf.training.evaluation import Evaluator

FILE = "eval_hardware.parquet"
CHANNELS = tuple(field.name for field in fields(Noise))
DENSITY_SECONDS = 3e-7  # for each wire and entry of a density matrix, one core; within a factor of 3 at 4 to 8 wires
RAYS = 64  # on which the samples of a view are estimated
KEYS = ["shots", "noise", "p", "seed"]
"""A row is one image under one condition: shots (0: exact), channel ("none": no noise), its probability, seed."""


@dataclass(frozen=True)
class Condition:
    """How circuits are measured: `shots` 0 is exact, `noise` "none" is without noise.

    Raises:
        ValueError: an unknown channel, no probability, or one without the other.
    """

    shots: int = 0
    noise: str = "none"
    p: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        at_least("shots", self.shots, 0)
        if self.noise not in ("none", *CHANNELS):
            raise ValueError(f"noise: unknown channel {self.noise!r}; known: {', '.join(CHANNELS)}")
        if not 0 <= self.p <= 1:
            raise ValueError(f"p must be a probability in [0, 1], got {self.p}")
        if (self.noise == "none") != (self.p == 0):
            raise ValueError(f"noise and p belong together, got noise={self.noise} p={self.p}")


def grid(shots: Sequence[int], noise: str, p: Sequence[float], seed: int) -> list[Condition]:
    """The exact rendering, then every number of shots with every probability of the channel.

    >>> [(c.shots, c.noise, c.p) for c in grid([100], "bit_flip", [0.01, 0.1], seed=0)]
    [(0, 'none', 0.0), (100, 'bit_flip', 0.01), (100, 'bit_flip', 0.1)]
    """
    pairs = itertools.product(shots or [0], p or [0.0])
    conditions = [Condition(count, noise if chance else "none", chance, seed) for count, chance in pairs]
    return list(dict.fromkeys([Condition(seed=seed), *conditions]))


def check_noise_feasible(evaluator: Evaluator, views: int) -> None:
    """ValueError if exact noise would take hours: with S > 1 every sample has a density matrix of 4^n entries."""
    layers = [m for m in evaluator.model.modules() if isinstance(m, QuantumLayer) and m.spectral > 1]
    work: list[float] = []  # wires times entries, of all samples in one call of a circuit

    def record(layer: QuantumLayer, inputs: tuple[Tensor]) -> None:
        work.append(len(inputs[0]) * layer.wires * 4.0**layer.wires)

    pixels = evaluator.table.view(evaluator.scene.eval[0])
    rays = pixels[:RAYS]
    with ExitStack() as hooks, torch.no_grad():
        for layer in layers:
            hooks.callback(layer.register_forward_pre_hook(record).remove)
        evaluator.model.eval()(rays, background=evaluator.background, step=0, watch=evaluator.watch)
    hours = sum(work) / len(rays) * views * len(pixels) * DENSITY_SECONDS / 3600
    if hours > 1:
        raise ValueError(
            f"noise: circuits with spectral > 1 need a density matrix a sample: about {hours:,.0f} hours "
            f"for {views} views; noise is quick for runs with qiren.spectral=1 or few qubits, shots for any"
        )


def evaluate_hardware(
    trained: Trained,
    conditions: Iterable[Condition],
    *,
    views: int = 0,
    tell: Callable[[str], None] = lambda line: None,
) -> pd.DataFrame:
    """Renders a finished run's held-out views under each condition and adds the rows to its eval_hardware.parquet.

    Args:
        trained: the run.
        conditions: rows of the same condition and image that the table already has are replaced.
        views: render the first so many held-out views; 0 for all.
        tell: takes a line of progress.

    Returns:
        The whole table: image, psnr, ssim, lpips, lpips_reason, depth_error, depth_error_median, and `KEYS`.

    Raises:
        ValueError: the run has no circuit, the noise would take hours, or the table is damaged.
    """
    folder, scene, model = trained.folder, trained.scene, trained.model
    if not any(isinstance(module, QuantumLayer) for module in model.modules()):
        raise ValueError(f"{folder}: neither of its heads has a re-uploading circuit")
    evaluator = Evaluator(
        scene,
        trained.ray_table(),
        model,
        background=trained.settings.render.background,
        chunk=trained.settings.train.chunk,
        watch=trained.stopwatch(model),
    )
    conditions = list(conditions)
    if any(condition.noise != "none" for condition in conditions):
        check_noise_feasible(evaluator, views or len(scene.eval))
    path = folder / FILE

    def measured() -> pd.DataFrame | None:
        return read_probe(folder, path.stem) if exists(path) else None

    measured()  # a damaged table is reported now
    table = pd.DataFrame()
    for condition in conditions:
        noise = Noise(**{condition.noise: condition.p}) if condition.noise != "none" else None
        rows = []
        with hardware_conditions.conditions(model, shots=condition.shots or None, noise=noise, seed=condition.seed):
            for _, row in evaluator.views(scene.eval[: views or None], trained.step):
                rows.append(row | vars(condition))
        new = pd.DataFrame(rows).astype({item.key: "float64" for item in image_metrics()})
        # Read and written after each condition, so that no row is lost if this stops or another command writes too.
        earlier = measured()
        table = new if earlier is None else pd.concat([earlier, new])
        table = table.drop_duplicates(["image", *KEYS], keep="last", ignore_index=True)
        replace(path, table.to_parquet())
        shots = f"{condition.shots} shots" if condition.shots else "exact"
        shown = [(metric_of(key).label, metric_of(key).with_unit(new[key].mean())) for key in ("psnr", "ssim")]
        quality = ", ".join(map(" ".join, shown))
        tell(f"{shots}, noise {condition.noise} {condition.p:g}: {quality}")
    return table
