"""How much two configurations differ over seeds and held-out views, and how sure that is."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
import pandas as pd
from scipy.optimize import brentq
from scipy.special import stdtrit

from qnerf.metrics import metric_of, quality_metrics
from qnerf.records import StoreError

from . import packed

LEVEL = 0.95
STAR_SEEDS = 5
"""A star needs at least so many seeds: with fewer, normally distributed seeds are too much of an assumption."""


@dataclass(frozen=True)
class Difference:
    """Mean of paired differences over `seeds` and `views`, and its interval, in the metric's unit.

    The bounds are infinite where one seed and one view leave nothing to estimate an error from. `p` is the smallest
    1 - level whose interval excludes zero, at least 1e-12. `effect` is the mean divided by the standard deviation of
    the differences over seeds (Cohen's d of paired samples); NaN without a spread.
    """

    mean: float
    low: float
    high: float
    p: float
    effect: float
    seeds: int
    views: int


def evaluations(runs: pd.DataFrame, metric: str = "psnr") -> pd.DataFrame:
    """Columns path, seed, image, value: the metric of each held-out image of each run.

    A run whose eval.parquet is absent, damaged or without the metric has no rows. ValueError for a metric that is not
    measured on each view.
    """
    if metric_of(metric) not in quality_metrics():
        known = ", ".join(item.key for item in quality_metrics())
        raise ValueError(f"{metric} is not measured for each view; such metrics are {known}")
    views = [_views(path, metric) for path in runs["path"]]
    counts = [len(images) for images, _ in views]
    return pd.DataFrame(
        {
            "path": np.repeat(runs["path"].to_numpy(), counts),
            "seed": np.repeat(runs["seed"].to_numpy(), counts),
            "image": list(chain.from_iterable(images for images, _ in views)),
            "value": np.concatenate([np.empty(0), *(values for _, values in views)]),
        }
    )


def paired(first: pd.DataFrame, second: pd.DataFrame) -> np.ndarray:
    """second - first of two `evaluations` as (seeds, views): seeds and images that both have, without NaN."""
    one, two = (part.pivot(index="seed", columns="image", values="value") for part in (first, second))
    difference = (two - one).reindex(index=one.index.intersection(two.index))
    return difference.dropna(axis=1).to_numpy(dtype=float)


def difference(differences: np.ndarray, *, level: float = LEVEL) -> Difference | None:
    """Mean of `differences` (seeds, views) and its interval; None where there are none.

    The model is d_sv = mean + seed_s + view_v + residual_sv with independent normal effects: another user has other
    seeds, and might have held out other views. The half width is

        sqrt(t(S - 1)^2 MS_seeds / (S V) + t(V - 1)^2 max(MS_views - MS_residual, 0) / (S V)),

    where MS are the mean squares of the two-way analysis of variance, and t(n) is the quantile of Student's t with n
    degrees of freedom. So each variance brings the quantile of its own degrees of freedom (Howe 1974, "Approximate
    confidence limits on the mean of X + Y where X and Y are two tabled independent random variables", Journal of the
    American Statistical Association 69). `benchmarks/coverage.py` measures how often it holds the true mean. With one
    seed the interval speaks about the choice of views alone, with one view about seeds alone.

    >>> difference(np.array([[1.0, 1.2], [0.8, 1.0], [0.6, 0.8]])).seeds
    3
    """
    seeds, views = differences.shape
    if seeds == 0 or views == 0:
        return None
    mean = float(differences.mean())
    by_seed, by_view = _squared_errors(differences)
    reach = np.sqrt(_squared_half_width(1 - level, by_seed, by_view, seeds, views))
    spread = differences.mean(axis=1).std(ddof=1) if seeds > 1 else 0.0
    effect = mean / spread if spread > 1e-9 * abs(mean) else np.nan  # rounding alone is no spread
    p = _p_value(mean, by_seed, by_view, seeds, views)
    return Difference(mean, float(mean - reach), float(mean + reach), p, float(effect), seeds, views)


def holm(p: Sequence[float]) -> np.ndarray:
    """Holm's correction (1979): adjusted p-values of several comparisons; NaN stays NaN and counts as none.

    >>> holm([0.01, 0.04, 0.03]).tolist()
    [0.03, 0.06, 0.06]
    """
    values = np.asarray(p, dtype=float)
    adjusted = np.full(values.shape, np.nan)
    order = [number for number in np.argsort(values) if not np.isnan(values[number])]
    largest = 0.0
    for rank, number in enumerate(order):
        largest = max(largest, min(1.0, float(values[number]) * (len(order) - rank)))
        adjusted[number] = largest
    return adjusted


def stars(p: Sequence[float], seeds: Sequence[float]) -> np.ndarray:
    """Which differences of one table differ from zero: at least `STAR_SEEDS` seeds, p < 0.05 after `holm`."""
    counts = np.asarray(seeds, dtype=float)
    return (counts >= STAR_SEEDS) & (holm(np.where(counts >= STAR_SEEDS, p, np.nan)) < 1 - LEVEL)


def method() -> str:
    """What `difference` and `stars` do, for under a table."""
    return (
        f"{100 * LEVEL:.0f} % interval of the mean difference, paired by seed and view (t over seeds and views); "
        f"* differs from 0 after Holm's correction for the rows with at least {STAR_SEEDS} seeds; effect: mean / "
        "standard deviation over seeds"
    )


def _squared_errors(differences: np.ndarray) -> tuple[float, float]:
    """The parts of the mean's squared standard error that seeds, and beyond them views, bring."""
    seeds, views = differences.shape
    mean, by_seed, by_view = differences.mean(), differences.mean(axis=1), differences.mean(axis=0)
    residual = differences - by_seed[:, None] - by_view + mean
    # One seed: the residual cannot be told from the views, whose whole variance counts.
    seed_square = views * by_seed.var(ddof=1) if seeds > 1 else 0.0
    view_square = seeds * by_view.var(ddof=1) if views > 1 else 0.0
    rest = (residual**2).sum() / ((seeds - 1) * (views - 1)) if seeds > 1 and views > 1 else 0.0
    return float(seed_square / differences.size), float(max(view_square - rest, 0.0) / differences.size)


def _squared_half_width(p: float, by_seed: float, by_view: float, seeds: int, views: int) -> float:
    if seeds == views == 1:
        return np.inf
    return sum(
        float(stdtrit(n - 1, 1 - p / 2)) ** 2 * error for n, error in ((seeds, by_seed), (views, by_view)) if n > 1
    )


def _p_value(mean: float, by_seed: float, by_view: float, seeds: int, views: int) -> float:
    def beyond(p: float) -> float:
        return _squared_half_width(p, by_seed, by_view, seeds, views) - mean**2

    smallest = 1e-12
    if seeds == views == 1 or mean == 0:
        return 1.0
    return smallest if beyond(smallest) <= 0 else float(brentq(beyond, smallest, 1.0))


def _views(path: str, metric: str) -> tuple[list[str], np.ndarray]:
    """Images and values; empty where the file is absent, damaged or without the metric."""
    try:
        own = packed.views(path)
        return own["image"].tolist(), own[metric].to_numpy()
    except (StoreError, KeyError):
        return [], np.empty(0)
