"""Every number that is shown of a run, declared once: what it is called, its unit, its digits, which way is better.

Tables, figures, the report and the command line read `METRICS`. A metric of held-out images has its computation in
`qnerf.training.image_metrics` under the same key.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

__all__ = [
    "HEAD_PARAMETERS",
    "METRICS",
    "OCTAVES",
    "Metric",
    "declare",
    "image_metrics",
    "metric_of",
    "quality_metrics",
    "shown_quality",
]


@dataclass(frozen=True)
class Metric:
    """How one column of summary.parquet or eval.parquet is shown.

    >>> psnr = metric_of("psnr")
    >>> psnr.heading, psnr.text(21.5), psnr.with_unit(21.5)
    ('PSNR, dB', '21.50', '21.50 dB')
    """

    key: str
    """The column's name."""
    label: str
    unit: str = ""
    digits: int | None = None
    """Decimals; None: four significant digits."""
    better: Literal["higher", "lower"] | None = None
    kind: Literal["image", "signal", "size", "time", "loss", ""] = ""
    """`image` metrics are measured on each held-out view, `signal` metrics on a signal that one head fits."""
    explanation: str = ""
    on_request: bool = False
    """Whether tables leave it out unless it is asked for."""
    within: float | None = None
    """The smallest difference that matters; None where a user has to say it."""

    @property
    def heading(self) -> str:
        """Label and unit, as a column or an axis names it."""
        return f"{self.label}, {self.unit}" if self.unit else self.label

    @property
    def sign(self) -> int:
        """1 where higher is better, -1 where lower is."""
        return -1 if self.better == "lower" else 1

    def text(self, value: Any, sign: str = "") -> str:
        """The number as it is printed; `sign="+"` also marks positive numbers."""
        return f"{value:{sign}.4g}" if self.digits is None else f"{value:{sign},.{self.digits}f}"

    def with_unit(self, value: Any) -> str:
        return f"{self.text(value)} {self.unit}".rstrip()


HEAD_PARAMETERS = ("params.density", "params.color", "params.head")
"""Columns with the parameters of a run's heads: two of a radiance field, one of a signal."""

OCTAVES = tuple(f"error_octave_{number}" for number in range(1, 9))
"""Keys of the error in each octave of spatial frequency, the lowest first; see `image_metrics.octave_errors`."""

COLORLESS = 0.25
"""Explained variance of held-out colours below which a run is colourless: it shows one colour, or nothing."""

METRICS: dict[str, Metric] = {}
"""Column -> metric, in the order in which tables show them."""


def declare(metric: Metric) -> Metric:
    """Adds a metric; ValueError where its key is taken."""
    if metric.key in METRICS:
        raise ValueError(f"metric {metric.key!r} is declared already, as {METRICS[metric.key].label!r}")
    METRICS[metric.key] = metric
    return metric


def image_metrics() -> list[Metric]:
    """The metrics that are measured on each held-out view."""
    return [metric for metric in METRICS.values() if metric.kind == "image"]


def quality_metrics() -> list[Metric]:
    """The metrics that an evaluation measures, on held-out views or on a signal."""
    return [metric for metric in METRICS.values() if metric.kind in ("image", "signal")]


def shown_quality(values: Mapping[str, Any]) -> list[Metric]:
    """The quality metrics that are among a run's values; those on request only where there are no others."""
    given = {key for key, value in values.items() if value is not None and value == value}
    found = [metric for metric in quality_metrics() if metric.key in given]
    return [metric for metric in found if not metric.on_request] or found


def metric_of(key: str) -> Metric:
    """The metric of a column, or of a key of metrics.parquet.

    `eval/psnr` is the PSNR of an evaluation, `psnr @ 100 shots` the PSNR under that condition.

    A column that is not declared is shown under its own name. Lower is better of one whose name says that it is a loss
    or an error.
    """
    if key in METRICS:
        return METRICS[key]
    measured, _, condition = key.partition(" @ ")
    if condition and measured in METRICS:
        return replace(METRICS[measured], key=key, label=f"{METRICS[measured].label}, {condition}")
    group, _, name = key.partition("/")
    if group not in _LOGGED or name not in METRICS:
        return Metric(key, key, better="lower" if _LOSSES & set(re.split(r"[^a-z]+", key.lower())) else None)
    return replace(METRICS[name], key=key, label=f"{_LOGGED[group]} {METRICS[name].label}".strip())


_LOSSES = {"loss", "error", "err", "mse", "rmse", "mae", "nll", "perplexity", "fid"}
_LOGGED = {"train": "training", "validation": "validation", "eval": "evaluation", "time": ""}

for _metric in (
    Metric("psnr", "PSNR", "dB", 2, "higher", "image", within=0.5),
    Metric(
        "psnr_view_dependent",
        "PSNR of view-dependent pixels",
        "dB",
        2,
        "higher",
        "image",
        "specular light raises a channel by at least 0.05",
        within=0.5,
    ),
    Metric("psnr_diffuse", "PSNR of the other pixels", "dB", 2, "higher", "image", "less specular light", within=0.5),
    Metric("ssim", "SSIM", "", 3, "higher", "image", within=0.01),
    Metric("lpips", "LPIPS", "", 4, "lower", "image"),
    Metric(
        "explained",
        "explained variance",
        "",
        3,
        "higher",
        "image",
        "share of the variance of true colours; 0 is one colour everywhere",
        on_request=True,
    ),
    Metric("depth_error", "depth error", "", 3, "lower", "image", "mean of |depth - truth| / the larger", within=0.01),
    Metric("depth_error_median", "median depth error", "world units", 3, "lower", "image", "median of |depth - truth|"),
    *(
        Metric(
            key,
            f"error in octave {number}",
            digits=4,
            better="lower",
            kind="image",
            explanation=f"of the truth's energy at {2 ** (number - 1)} to {2**number} cycles a side",
            on_request=True,
        )
        for number, key in enumerate(OCTAVES, 1)
    ),
    Metric(
        "psnr_unseen", "PSNR of unseen pixels", "dB", 2, "higher", "signal", "pixels kept out of training", within=0.5
    ),
    Metric(
        "distance_error", "distance error", "", 4, "lower", "signal", "mean of |distance - truth|, in sides of the cube"
    ),
    Metric("iou", "IoU", "", 3, "higher", "signal", "intersection over union of the inside"),
    Metric("eikonal_error", "eikonal error", "", 3, "lower", "signal", "mean of | |gradient| - 1 |"),
    Metric("params.heads", "head parameters", "", 0, kind="size", on_request=True),
    Metric("params.encoder", "encoder parameters", "", 0, kind="size"),
    Metric("params.density", "density parameters", "", 0, kind="size"),
    Metric("params.color", "colour parameters", "", 0, kind="size"),
    Metric("params.head", "parameters of the head", "", 0, kind="size"),
    Metric("params.sampler", "proposal parameters", "", 0, kind="size"),
    Metric("params.cameras", "camera parameters", "", 0, kind="size"),
    Metric("params.appearance", "appearance parameters", "", 0, kind="size"),
    Metric("params.total", "parameters", "", 0, kind="size"),
    Metric("step_ms", "time of a step", "ms", 1, "lower", "time", "median"),
    Metric("step_cpu_ms", "CPU time of a step", "ms", 1, "lower", "time", "median, all threads", on_request=True),
    Metric("train_s", "training time", "s", 0, "lower", "time"),
    Metric("time.quantum_ms", "circuits' part of a step", "ms", 1, "lower", "time", on_request=True),
    Metric("time.load", "load", "", 2, explanation="processes that run or wait, for each core", on_request=True),
    Metric("time.beside", "runs side by side", "", 0, explanation="that began in one process", on_request=True),
    Metric("eval_s", "evaluation time", "s", 1, "lower", "time", on_request=True),
    Metric("cost.gates", "gates", kind="size", on_request=True, explanation="of all circuits of the heads"),
    Metric("cost.two_qubit_gates", "two-qubit gates", kind="size", on_request=True, explanation="CNOT and CZ"),
    Metric("cost.depth", "depth", kind="size", on_request=True, explanation="of the deepest circuit"),
    Metric("cost.view_hours", "device time of a view", "h", kind="size", on_request=True),
    Metric("cost.train_hours", "device time of the training", "h", kind="size", on_request=True),
    Metric("dead", "dead units", "", 2, on_request=True, explanation="share that is 0 on all samples"),
    Metric("spread", "spread", on_request=True, explanation="of raw outputs over samples"),
    Metric("peak_memory_mb", "peak memory", "MB", 0, "lower", on_request=True),
    Metric("loss", "loss", "", 5, "lower", "loss", on_request=True),
    Metric("mse", "mean squared error", "", 5, "lower", "loss", on_request=True),
):
    declare(_metric)
