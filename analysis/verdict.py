"""Is one configuration better than another, worse, equivalent, or is that undecided?

Two groups of runs that differ only in their seeds are compared by the mean of a metric over the held-out views that
every run of both groups has. A verdict is about the typical run, the mean of a group without its lowest and its highest
fifth, so runs that slip do not decide it: how many do is counted apart. The test is Yuen's (Biometrika 61, 1974), which
is Welch's on trimmed means. Seeds of two heads are not paired: equal seeds draw the same rays, and that explains
nothing of how two different heads end.

`within` is the smallest difference that matters, in the metric's unit. Only one of "equivalent" and "better or worse"
can be wrong, so both are tested at the whole error rate `alpha`.
"""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import comb
from typing import Literal

import numpy as np
import pandas as pd
from scipy.special import stdtrit

from qnerf.metrics import metric_of, quality_metrics
from qnerf.records import StoreError

from . import packed

ALPHA = 0.05
"""The share of verdicts that may be wrong, where there is no difference or one of exactly `within`."""
TRIM, TRIMMED_FROM = 0.2, 6
"""The share of a group that is trimmed at either end, and the smallest group that is trimmed."""
SLIP = 1.5
"""A run that is more dB below the median of its group slipped."""

Kind = Literal["better", "worse", "equivalent", "undecided"]


@dataclass(frozen=True)
class Verdict:
    """What runs say about `difference`, other - baseline in the metric's unit.

    `reach` is the half width of its interval of level 1 - alpha, infinite where a side has fewer than two runs.
    `excluded` names what an undecided comparison rules out, "a loss" or "a gain" of at least `within`; of an
    equivalent one, "above 0" or "below 0" where the interval excludes 0. `seeds` and `slipped` count all runs and those
    that slipped or diverged, baseline first; `uneven`: one side slips more often (Fisher).
    """

    kind: Kind
    difference: float
    reach: float
    error: float
    freedom: float
    within: float
    excluded: str = ""
    star: bool = False
    seeds: tuple[int, int] = (0, 0)
    slipped: tuple[int, int] = (0, 0)
    uneven: bool = False

    def text(self, metric: str = "psnr") -> str:
        """`better *`, `equivalent, above 0`, `undecided: a loss of 0.5 dB is ruled out`."""
        more = self.excluded and (
            f", {self.excluded}"
            if self.kind == "equivalent"
            else f": {self.excluded} of {self.within:g} {metric_of(metric).unit}".rstrip() + " is ruled out"
        )
        sides = zip(("baseline ", ""), self.slipped, self.seeds, strict=True)
        slipped = [f"; {side}slipped {gone} of {runs}" for side, gone, runs in sides if gone]
        often = ", one side more often" if self.uneven else ""
        return self.kind + more + (" *" if self.star else "") + "".join(slipped) + often


def judge(
    difference: float, error: float, freedom: float, within: float, *, sign: int = 1, alpha: float = ALPHA
) -> Verdict:
    """The verdict on a difference with its standard error and degrees of freedom.

    sign: -1 where a lower value is better. within: of 0, nothing is equivalent.

    >>> judge(0.1, 0.1, 18, 0.5).kind, judge(1.2, 0.2, 18, 0.5).kind, judge(0.4, 0.2, 18, 0.5).excluded
    ('equivalent', 'better', 'a loss')
    """
    one, two = (error * stdtrit(freedom, 1 - share) if freedom > 0 else np.inf for share in (alpha, alpha / 2))
    nonzero = abs(difference) > two
    kind: Kind = "undecided"
    excluded = ""
    if abs(difference) + one < within:
        kind = "equivalent"
        excluded = ("above 0" if difference > 0 else "below 0") if nonzero else ""
    elif nonzero:
        kind = "better" if sign * difference > 0 else "worse"
    elif within and sign * difference - one > -within:
        excluded = "a loss"
    elif within and sign * difference + one < within:
        excluded = "a gain"
    return Verdict(kind, float(difference), float(two), float(error), float(freedom), within, excluded)


def pooled(squares: np.ndarray, freedoms: np.ndarray) -> tuple[float, float]:
    """Standard error of a sum of independent parts with these squared errors; Satterthwaite's degrees of freedom."""
    total = float(squares.sum())
    freedom = total**2 / (squares**2 / freedoms).sum() if total else freedoms.sum()
    return total**0.5, float(freedom)


def yuen(baseline: np.ndarray, other: np.ndarray) -> tuple[float, float, float]:
    """Difference of the trimmed means, its standard error and degrees of freedom: 0 for a group of one.

    A value may be infinite where it is trimmed.
    """
    share = trim(baseline, other)
    centres, squares, freedoms = np.array([trimmed(np.sort(group), share) for group in (baseline, other)]).T
    difference = float(centres[1] - centres[0])
    if freedoms.min() < 1:
        return difference, float("nan"), 0.0
    squares *= squares.sum() > (1e-12 * np.abs(centres).max()) ** 2  # rounding alone is no spread
    return difference, *pooled(squares, freedoms)


def trim(*groups: Sequence[float] | np.ndarray) -> float:
    """The share that is trimmed of these groups: of all alike, and of none where one is small.

    Where none is trimmed, Yuen's test is Welch's of the means.
    """
    return TRIM if min(map(len, groups)) >= TRIMMED_FROM else 0.0


def trimmed(values: np.ndarray, share: float) -> tuple[float, float, int]:
    """Trimmed mean of sorted values, its squared error by the winsorised variance, and degrees of freedom."""
    number = len(values)
    cut = int(share * number)
    kept = number - 2 * cut
    if kept < 2:
        return float(values.mean()), float("nan"), 0
    spread = np.var(values.clip(values[cut], values[-cut - 1]), ddof=1)
    return float(values[cut : number - cut].mean()), float((number - 1) * spread / (kept * (kept - 1))), kept - 1


def slips(group: np.ndarray, unit: str) -> int:
    """How many runs diverged (NaN) or, of a metric in dB, are more than `SLIP` below the median of the group."""
    low = (
        group < np.nanmedian(group) - SLIP if unit == "dB" and np.isfinite(group).any() else np.zeros(len(group), bool)
    )
    return int((low | np.isnan(group)).sum())


def verdict(
    baseline: Sequence[float] | np.ndarray,
    other: Sequence[float] | np.ndarray,
    within: float,
    *,
    metric: str = "psnr",
    alpha: float = ALPHA,
    comparisons: int = 0,
) -> Verdict:
    """The verdict on the runs of `other` against the runs of `baseline`, a value a run.

    comparisons: how many rows the table has; a star stands where the verdict holds at alpha / comparisons, too.
    A run that diverged (NaN) is the worst of its group. Where more diverged than are trimmed, the verdict is undecided,
    and the difference that of the other runs. ValueError for a value of infinity: an exact fit has no PSNR.
    """
    groups = [np.asarray(group, dtype=float) for group in (baseline, other)]
    if infinite := sum(int(np.isinf(group).sum()) for group in groups):
        raise ValueError(f"{metric} of {infinite} runs is infinite, so their mean says nothing: compare another metric")
    item = metric_of(metric)
    kept = [group[~np.isnan(group)] for group in groups]
    worst = [np.where(np.isnan(group), -item.sign * np.inf, group) for group in groups]
    seeds = len(groups[0]), len(groups[1])
    slipped = slips(groups[0], item.unit), slips(groups[1], item.unit)
    if all(len(group) - len(own) <= int(trim(*groups) * len(group)) for group, own in zip(groups, kept, strict=True)):
        found = yuen(*worst) if min(seeds) else (np.nan, np.nan, 0.0)
    else:
        found = (yuen(*kept)[0] if min(map(len, kept)) else np.nan, np.nan, 0.0)
    made = judge(*found, within, sign=item.sign, alpha=alpha)
    strict = judge(*found, within, sign=item.sign, alpha=alpha / comparisons).kind if comparisons else "undecided"
    star, uneven = made.kind == strict != "undecided", fisher(slipped, seeds) < alpha
    return replace(made, star=star, seeds=seeds, slipped=slipped, uneven=uneven)


def fisher(slipped: tuple[int, int], seeds: tuple[int, int]) -> float:
    """The p-value of Fisher's exact test that both sides slip equally often."""
    ways = [comb(seeds[0], gone) * comb(seeds[1], sum(slipped) - gone) for gone in range(sum(slipped) + 1)]
    return sum(way for way in ways if way <= ways[slipped[0]]) / sum(ways)


def over_scenes(verdicts: Sequence[Verdict], *, sign: int = 1) -> list[Verdict]:
    """The verdict on the mean difference over exactly these scenes, which count alike.

    From three scenes on a second one: on the mean over scenes of which these are a sample (t over scenes).
    """
    differences, errors, freedoms = np.array([(one.difference, one.error, one.freedom) for one in verdicts]).T
    number = len(verdicts)
    found = [pooled((errors / number) ** 2, freedoms)]
    if number > 2:
        found.append((differences.std(ddof=1) / number**0.5, number - 1))
    return [judge(differences.mean(), *one, verdicts[0].within, sign=sign) for one in found]


def within_of(metric: str, asked: float | None = None, otherwise: float | None = None) -> float:
    """`asked`, or the metric's own smallest difference that matters, or `otherwise`: 0 says that none is known.

    ValueError where neither is a positive number, or the metric is a size or a time.
    """
    if metric_of(metric).kind in ("size", "time"):
        known = ", ".join(item.key for item in quality_metrics())
        raise ValueError(f"{metric} is not measured for each view; such metrics are {known}")
    within = metric_of(metric).within if asked is None else asked
    if within is None and otherwise is not None:
        return otherwise
    if within is None:
        unit = metric_of(metric).unit or "its unit"
        raise ValueError(f"{metric}: give --within, the smallest difference that matters, in {unit}")
    if not 0 < within < np.inf:
        raise ValueError(f"--within: expected a positive number, got {within:g}")
    return within


def evaluations(runs: pd.DataFrame, metric: str = "psnr") -> pd.DataFrame:
    """The metric of each held-out view of each run: a row a run, named by its path, and a column a view.

    A run whose eval.parquet is absent, damaged or without the metric has no row.
    """
    rows = {}
    for path in runs["path"]:
        with contextlib.suppress(StoreError, KeyError):
            rows[path] = packed.views(path).set_index("image")[metric].to_dict()
    return pd.DataFrame.from_dict(rows, orient="index", dtype=float)


def measured(runs: pd.DataFrame, metric: str) -> pd.DataFrame:
    """`evaluations`; where no run has any, as in loops of a user's own, the metric of the whole run as one column."""
    views = evaluations(runs, metric)
    return runs.set_index("path")[[metric]] if views.empty else views


def compare(
    baseline: pd.DataFrame, other: pd.DataFrame, within: float, *, metric: str = "psnr", comparisons: int = 0
) -> tuple[Verdict, float]:
    """The verdict on two groups of `evaluations`, and how far other views would move the difference.

    Views that only some of the runs have count nowhere; without common views the difference is NaN. The second number
    is the half width of Student's interval over the views' mean differences: 0 for one view.
    """
    together = pd.concat([baseline, other], join="inner").dropna(axis=1)
    if together.columns.empty:
        return Verdict("undecided", np.nan, np.inf, np.nan, 0.0, within), 0.0
    one, two = (group[list(together)] for group in (baseline, other))
    found = verdict(one.mean(axis=1), two.mean(axis=1), within, metric=metric, comparisons=comparisons)
    views = (two.mean() - one.mean()).to_numpy()
    moved = stdtrit(len(views) - 1, 1 - ALPHA / 2) * views.std(ddof=1) / len(views) ** 0.5 if len(views) > 1 else 0.0
    return found, float(moved)


def method(metric: str, within: float, *, views: bool = True) -> str:
    """What a table's verdicts are, for under it; views: whether a run is the mean of several."""
    band = f"the 90 % interval is within ± {within:g} {metric_of(metric).unit}".rstrip()
    return (
        f"trimmed means of the runs{' over the same views' * views} (Yuen's t), ± of 95 %; equivalent: "
        f"{band if within else 'give --within, the smallest difference that matters'}; "
        "* holds for all rows together; no registered study"
    )
