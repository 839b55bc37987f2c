"""How often the interval of a difference holds the true difference: `python -m benchmarks.coverage`.

Takes all pairs of configurations of docs/results/seeds (ten seeds, two scenes), estimates how much seeds, views and
their residuals vary in each pair's differences, and draws new experiments with these variances and a true difference
of 0. The effects are drawn from normal distributions, or from the measured effects themselves (`measured`), which are
skewed. An interval of 95 % should hold 0 in 95 % of the experiments. Compared are

- `t over seeds and views`: what the tables print, `qnerf.analysis.statistics.difference`;
- `t over seeds alone`: Student's interval of the seeds' means, which takes the views as given;
- `bootstrap`: percentiles of means over resampled seeds and views (Owen 2007, "The pigeonhole bootstrap", Annals of
  Applied Statistics 1(2)).

Prints the table and saves it in benchmarks/results/coverage.parquet.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
from qnerf.analysis import load, statistics
from scipy.special import stdtrit

RESULTS = Path(__file__).parent / "results" / "coverage.parquet"
SEEDS_PACK = Path(__file__).parents[1] / "docs" / "results" / "seeds"
CONFIGURATION = ["scene_name", "field", "density.mlp.init", "color.mlp.init", "color.directions"]
RESAMPLES = 500

Bounds = tuple[float, float]


@dataclass(frozen=True)
class Effects:
    """Measured effects of one pair, centred: seeds (S,), views (V,), residuals (S, V); standard deviations of each."""

    scene: str
    seeds: np.ndarray
    views: np.ndarray
    residuals: np.ndarray
    spread: tuple[float, float, float]

    def draw(self, count: int, kind: str, random: np.random.Generator) -> np.ndarray:
        """An experiment (count, V) of mean 0."""
        shapes = ((count, 1), (1, self.views.size), (count, self.views.size))
        if kind == "normal":
            return sum(
                deviation * random.normal(size=shape) for deviation, shape in zip(self.spread, shapes, strict=True)
            )
        parts = (self.seeds, self.views, self.residuals.ravel())
        return sum(
            deviation * random.choice(part / max(part.std(), 1e-12), size=shape)
            for deviation, part, shape in zip(self.spread, parts, shapes, strict=True)
        )


def measured(store: Path) -> list[Effects]:
    """The effects of every pair of configurations of the same scene."""
    runs = load.runs(store, "state=finished")
    keys = [key for key in CONFIGURATION if key in runs]
    group = dict(zip(runs["path"], runs.groupby(keys, dropna=False).ngroup(), strict=True))
    scene = dict(zip(runs["path"].map(group), runs["scene_name"], strict=True))
    views = statistics.evaluations(runs)
    parts = dict(list(views.groupby(views["path"].map(group))))
    pairs = [pair for pair in combinations(parts, 2) if scene[pair[0]] == scene[pair[1]]]
    return [effects(scene[one], statistics.paired(parts[one], parts[two])) for one, two in pairs]


def effects(scene: str, differences: np.ndarray) -> Effects:
    """Two-way analysis of variance with one observation a cell; a negative estimate of a variance counts as 0."""
    count, views = differences.shape
    mean = differences.mean()
    by_seed, by_view = differences.mean(axis=1) - mean, differences.mean(axis=0) - mean
    residual = differences - mean - by_seed[:, None] - by_view
    rest = (residual**2).sum() / ((count - 1) * (views - 1))
    variances = by_seed.var(ddof=1) - rest / views, by_view.var(ddof=1) - rest / count, rest
    a, b, c = (float(np.sqrt(max(variance, 0.0))) for variance in variances)
    return Effects(scene, by_seed, by_view, residual, (a, b, c))


def ours(differences: np.ndarray, random: np.random.Generator) -> Bounds:
    found = statistics.difference(differences)
    assert found is not None
    return found.low, found.high


def over_seeds(differences: np.ndarray, random: np.random.Generator) -> Bounds:
    means = differences.mean(axis=1)
    reach = stdtrit(means.size - 1, 0.975) * means.std(ddof=1) / np.sqrt(means.size)
    return means.mean() - reach, means.mean() + reach


def bootstrap(differences: np.ndarray, random: np.random.Generator) -> Bounds:
    by_seed, by_view = (random.multinomial(n, np.full(n, 1 / n), RESAMPLES) / n for n in differences.shape)
    means = ((by_seed @ differences) * by_view).sum(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)


METHODS = {"t over seeds and views": ours, "t over seeds alone": over_seeds, "bootstrap": bootstrap}


def rows(pairs: list[Effects], counts: list[int], experiments: int) -> Iterator[dict[str, object]]:
    """A row a method, pair, kind of draw and number of seeds: share of intervals that hold 0, and mean width in dB."""
    random = np.random.default_rng(0)
    for number, pair in enumerate(pairs):
        for kind in ("normal", "measured"):
            for count in counts:
                drawn = [pair.draw(count, kind, random) for _ in range(experiments)]
                for name, method in METHODS.items():
                    low, high = np.array([method(differences, random) for differences in drawn]).T
                    common = {"scene": pair.scene, "views": pair.views.size, "pair": number, "draws": kind}
                    shares = {"covered": float(((low <= 0) & (high >= 0)).mean()), "width": float((high - low).mean())}
                    yield common | {"seeds": count, "method": name, "experiments": experiments} | shares


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", type=Path, default=SEEDS_PACK, help="runs with many seeds; default: %(default)s")
    parser.add_argument("--seeds", type=int, nargs="+", default=[2, 3, 5, 10])
    parser.add_argument("--experiments", type=int, default=400, help="for each pair; default: %(default)s")
    options = parser.parse_args()
    table = pd.DataFrame(rows(measured(options.store), options.seeds, options.experiments))
    means = table.groupby(["scene", "views", "draws", "seeds", "method"], as_index=False)[["covered", "width"]].mean()
    means["lowest"] = table.groupby(["scene", "views", "draws", "seeds", "method"])["covered"].min().to_numpy()
    means["experiments"] = options.experiments * table["pair"].nunique() // table["scene"].nunique()
    means.to_parquet(RESULTS, index=False)
    shown = means.pivot(index=["scene", "draws", "method"], columns="seeds", values=["covered", "width"])
    print(shown.to_string(float_format="{:.3f}".format))


if __name__ == "__main__":
    main()
