"""Looking several times at the same comparison, without more than `ALPHA` wrong verdicts over all looks.

Look k at n_k seeds a side spends ALPHA (n_k^2 - n_(k-1)^2) / most^2. The shares add up to ALPHA, so by the union bound
no more than that is wrong wherever one stops. `most`, the last look, is fixed once the first runs show what one costs.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy import stats

from ..verdict import ALPHA, Verdict, collapses, verdict, welch

FIRST, MOST = 4, 20
POWER, MARGIN = 0.8, 1.15
"""Of the planner: the share of decided studies, and how many more seeds several looks take than a single one."""


def looks(most: int = MOST) -> list[int]:
    """Numbers of seeds at which to look: each half as many more, the last is `most`.

    >>> looks(20), looks(5)
    ([4, 6, 9, 14, 20], [4, 5])
    """
    found = [min(FIRST, most)]
    while found[-1] < most:
        found.append(min(most, math.ceil(1.5 * found[-1])))
    return found


def shares(most: int = MOST) -> list[float]:
    """The error rate that each look may spend; they add up to `ALPHA`."""
    return [ALPHA * (after**2 - before**2) / most**2 for before, after in pairwise([0, *looks(most)])]


def affordable(budget: float, cost: float) -> int:
    """The last look: as many seeds a side as `budget` seconds pay at `cost` seconds for one of each, up to `MOST`."""
    return int(min(MOST, max(FIRST, budget // max(cost, 1e-9))))


def look(
    baseline: Sequence[float], other: Sequence[float], within: float, alpha: float, metric: str = "psnr"
) -> tuple[Verdict, float]:
    """The verdict at error rate `alpha`, and the p-value of Fisher's test that one side collapses more often."""
    found = replace(verdict(baseline, other, within, metric=metric, alpha=alpha), star=False)
    table = [[gone, kept] for gone, kept in zip(found.collapsed, found.seeds, strict=True)]
    return found, float(stats.fisher_exact(table).pvalue)


def race(
    values: Mapping[str, Sequence[float]], within: float, alpha: float, sign: int = 1
) -> tuple[str, list[str], bool]:
    """Of several candidates the leader, those that are worse than it, and whether the rest is surely within `within`.

    Each one-sided bound of the leader's gain is at alpha / (number of candidates - 1).
    """
    kept = {name: np.asarray(own, dtype=float) for name, own in values.items()}
    best = max(kept, key=lambda name: sign * np.nanmean(kept[name]))
    worse, close = [], True
    for name, own in kept.items():
        if name == best:
            continue
        dropped = collapses(own, kept[best])
        gain, error, freedom = welch(own[~dropped[0]], kept[best][~dropped[1]])
        reach = error * stats.t.ppf(1 - alpha / (len(kept) - 1), freedom) if freedom else np.inf
        if sign * gain - reach > 0:
            worse.append(name)
        elif sign * gain - reach <= -within:
            close = False
    return best, worse, close


def seeds_needed(deviations: tuple[float, float], within: float, difference: float = 0.0) -> int:
    """Seeds a side with which a true `difference` is decided in `POWER` of studies: as equivalent if it is 0."""
    for count in range(2, 1000):
        error = math.hypot(*deviations) / math.sqrt(count)
        freedom = _freedom(deviations, count)
        if difference:
            power = stats.nct.sf(stats.t.ppf(1 - ALPHA / 2, freedom), freedom, abs(difference) / error)
        else:
            power = 2 * stats.t.cdf(within / error - stats.t.ppf(1 - ALPHA, freedom), freedom) - 1
        if power >= POWER:
            return math.ceil(MARGIN * count)
    return 1000


def planned(
    baseline: Sequence[float], other: Sequence[float], within: float, difference: float = 0.0
) -> tuple[int, int]:
    """`seeds_needed` as a range: with both standard deviations of the pilot runs at either end of their 80 % interval.

    A few pilot runs say little about their spread, so the range is wide: that is what it is for.
    """
    low, high = ([], [])
    for group in (baseline, other):
        freedom = len(group) - 1
        deviation = float(np.std(group, ddof=1))
        low.append(deviation * math.sqrt(freedom / stats.chi2.ppf(0.9, freedom)))
        high.append(deviation * math.sqrt(freedom / stats.chi2.ppf(0.1, freedom)))
    return seeds_needed((low[0], low[1]), within, difference), seeds_needed((high[0], high[1]), within, difference)


def _freedom(deviations: tuple[float, float], count: int) -> float:
    squares = np.square(deviations)
    return float((count - 1) * squares.sum() ** 2 / max((squares**2).sum(), 1e-300))
