"""A trained run rendered as on hardware: with finitely many shots, or with noisy gates."""

import itertools
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import pandas as pd

from qnerf.config import bounds
from qnerf.metrics import image_metrics, metric_of
from qnerf.probes.trained import Trained
from qnerf.quantum import hardware_conditions
from qnerf.quantum.noise import CHANNELS, Noise
from qnerf.records.files import replace
from qnerf.records.read import read_probe
from qnerf.training.evaluation import Evaluator
from qnerf.training.forecast import TELL, announced

FILE = "eval_hardware.parquet"
OTHERS = tuple(field.name for field in fields(Noise) if field.name not in CHANNELS)
KEYS = ["shots", "noise", "p", "seed"]
"""A row is one image under one condition: shots (0: exact), channel ("none": no noise), its probability, seed."""


@dataclass(frozen=True)
class Condition:
    """How circuits are measured: `shots` 0 is exact, `noise` "none" is without noise.

    `others` are further fields of `Noise` with their values, such as ("readout", 0.02). ValueError for an unknown
    channel, no probability, one without the other, or values that `Noise` refuses.
    """

    shots: int = 0
    noise: str = "none"
    p: float = 0.0
    seed: int = 0
    others: tuple[tuple[str, float], ...] = ()

    def __post_init__(self) -> None:
        bounds.check("shots", self.shots, bounds.NonNegativeInt)
        if self.noise not in ("none", *CHANNELS):
            raise ValueError(f"noise: unknown channel {self.noise!r}; known: {', '.join(CHANNELS)}")
        if not 0 <= self.p <= 1:
            raise ValueError(f"p must be a probability in [0, 1], got {self.p}")
        if (self.noise == "none") != (self.p == 0):
            raise ValueError(f"noise and p belong together, got noise={self.noise} p={self.p}")
        _ = self.device

    @property
    def device(self) -> Noise:
        channel = {self.noise: self.p} if self.noise != "none" else {}
        return Noise(**channel, **dict(self.others))

    @property
    def keys(self) -> dict[str, Any]:
        """The values of `KEYS`."""
        channel = [self.noise] if self.noise != "none" or not self.others else []
        text = " ".join([*channel, *(f"{name}={value:g}" for name, value in self.others)])
        return {"shots": self.shots, "noise": text, "p": self.p, "seed": self.seed}


def grid(
    shots: Sequence[int], noise: str, p: Sequence[float], seed: int, others: Mapping[str, float] = {}
) -> list[Condition]:
    """The exact rendering, then every number of shots with every probability of the channel, all with the `others`.

    >>> [(c.shots, c.noise, c.p) for c in grid([100], "bit_flip", [0.01, 0.1], seed=0)]
    [(0, 'none', 0.0), (100, 'bit_flip', 0.01), (100, 'bit_flip', 0.1)]
    >>> grid([], "depolarizing", [0.001], 0, {"two_qubit": 0.01})[-1].keys["noise"]
    'depolarizing two_qubit=0.01'
    """
    pairs = itertools.product(shots or [0], p or [0.0])
    conditions = [
        Condition(count, noise if chance else "none", chance, seed, tuple(others.items())) for count, chance in pairs
    ]
    return list(dict.fromkeys([Condition(seed=seed), *conditions]))


def seconds_of(evaluator: Evaluator, condition: Condition, patterns: int, views: Sequence[int]) -> float:
    """About how long a condition takes, from rendering a few rays under it."""
    given = {"shots": condition.shots or None, "noise": condition.device, "patterns": patterns}
    with hardware_conditions.conditions(evaluator.model, **given, seed=condition.seed):
        return evaluator.seconds(int(evaluator.scene.cameras.all_sizes[list(views)].prod(1).sum()))


def evaluate_hardware(
    trained: Trained,
    conditions: Iterable[Condition],
    *,
    views: int = 0,
    patterns: int = 100,
    tell: Callable[[str], None] = lambda line: None,
) -> pd.DataFrame:
    """Renders a finished run's held-out views under each condition and adds the rows to its eval_hardware.parquet.

    Rows of the same condition and image are replaced. Returns the whole table: image, the image metrics, and `KEYS`.
    ValueError where the run has no circuit, or the table is damaged.

    views: render the first so many; 0 for all. patterns: of Pauli errors for each call of a circuit, where density
    matrices are too slow, see `Conditions`. tell: takes a line of progress.
    """
    folder, scene, model = trained.folder, trained.scene, trained.model
    trained.circuits()  # ValueError without circuits
    evaluator = Evaluator(
        scene,
        trained.ray_table(),
        model,
        background=trained.settings.render.background,
        chunk=trained.settings.train.chunk,
        watch=trained.stopwatch(model),
    )
    conditions = list(conditions)
    path = folder / FILE

    def measured() -> pd.DataFrame | None:
        return read_probe(folder, path.stem) if path.exists() else None

    measured()  # a damaged table is reported now
    table, chosen = pd.DataFrame(), scene.eval[: views or None]
    costs = [condition for condition in conditions if condition.device.gates or condition.shots]
    seconds = sum(seconds_of(evaluator, condition, patterns, chosen) for condition in costs)
    what = f"{len(conditions)} conditions, {len(chosen)} views"
    if line := announced(what, seconds, trained.settings.run.hours, "views= renders fewer"):
        tell(line)
    for condition in conditions:
        rows, told = [], time.monotonic()
        with hardware_conditions.conditions(
            model, shots=condition.shots or None, noise=condition.device, seed=condition.seed, patterns=patterns
        ) as measuring:
            for _, row in evaluator.views(chosen, trained.step):
                rows.append(row | condition.keys)
                if time.monotonic() - told > TELL and len(rows) < len(chosen):
                    tell(f"{_text(condition)}: {len(rows)} of {len(chosen)} views")
                    told = time.monotonic()
        new = pd.DataFrame(rows).astype({item.key: "float64" for item in image_metrics()})
        # Read and written after each condition, so that no row is lost if this stops or another command writes too.
        earlier = measured()
        table = new if earlier is None else pd.concat([earlier, new])
        table = table.drop_duplicates(["image", *KEYS], keep="last", ignore_index=True)
        replace(path, table.to_parquet())
        shown = [(metric_of(key).label, metric_of(key).with_unit(new[key].mean())) for key in ("psnr", "ssim")]
        quality = ", ".join(map(" ".join, shown))
        sampled = f"; standard error of a value {measuring.standard_error:.2g}" if measuring.standard_error else ""
        tell(f"{_text(condition)}: {quality}{sampled}")
    return table


def _text(condition: Condition) -> str:
    shots = f"{condition.shots} shots" if condition.shots else "exact"
    channel = [(condition.noise, condition.p)] if condition.p else []
    noise = " ".join(f"{name}={value:g}" for name, value in [*channel, *condition.others])
    return f"{shots}, {noise or 'without noise'}"
