"""How much two configurations differ over seeds and held-out views, and how sure that is."""

from dataclasses import dataclass
from itertools import chain

import numpy as np
import pandas as pd

from qnerf.metrics import metric_of, quality_metrics
from qnerf.records import StoreError

from . import packed

RESAMPLES = 10_000
LEVEL = 0.95


@dataclass(frozen=True)
class Difference:
    """Mean of paired differences and its bootstrap interval, in the metric's unit; the number of seeds and views."""

    mean: float
    low: float
    high: float
    seeds: int
    views: int

    @property
    def significant(self) -> bool:
        """Whether the interval excludes zero."""
        return self.low > 0 or self.high < 0


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


def bootstrap(
    differences: np.ndarray, *, level: float = LEVEL, resamples: int = RESAMPLES, seed: int = 0
) -> Difference | None:
    """Percentile interval of the mean of `differences` (seeds, views); None where there is nothing to resample.

    Seeds and views are resampled independently, with replacement (Owen 2007, "The pigeonhole bootstrap", Annals of
    Applied Statistics 1(2)). All seeds share the same views; drawing views anew for each seed would average away how
    hard a view is and make the interval too narrow. With few seeds the interval still covers the true difference less
    often than `level`: in simulations with 22 views, 0.79 to 0.94 for 3 seeds and 0.93 to 0.95 for 10. With one seed
    the interval covers the choice of views only.
    """
    seeds, views = differences.shape
    if seeds == 0 or views == 0:
        return None
    random = np.random.default_rng(seed)
    by_seed, by_view = (random.multinomial(n, np.full(n, 1 / n), resamples) / n for n in (seeds, views))
    means = ((by_seed @ differences) * by_view).sum(axis=1)
    tail = 50 * (1 - level)
    low, high = np.percentile(means, [tail, 100 - tail])
    return Difference(float(differences.mean()), float(low), float(high), seeds, views)


def method(level: float = LEVEL, resamples: int = RESAMPLES) -> str:
    """What `bootstrap` does, in one line for under a table."""
    return (
        f"{100 * level:.0f} % percentile interval of the mean difference, paired by seed and view; seeds and views "
        f"resampled independently, {resamples:,} times; too narrow with few seeds; not corrected for several rows"
    )


def _views(path: str, metric: str) -> tuple[list[str], np.ndarray]:
    """Images and values; empty where the file is absent, damaged or without the metric."""
    try:
        own = packed.views(path)
        return own["image"].tolist(), own[metric].to_numpy()
    except (StoreError, KeyError):
        return [], np.empty(0)
