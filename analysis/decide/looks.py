"""Looking several times at the same comparison, without more than `ALPHA` wrong verdicts over all looks.

Look k at n_k seeds a side spends ALPHA (n_k^2 - n_(k-1)^2) / most^2. The shares add up to ALPHA, so by the union bound
no more than that is wrong wherever one stops. `most`, the last look, is fixed once the first runs show what one costs.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy import stats

from ..verdict import ALPHA, TRIM, TRIMMED_FROM, pooled

FIRST, MOST = 6, 20
POWER, MARGIN, EFFICIENCY = 0.8, 1.15, 0.9
"""Of the planner: the share of decided studies, how many more seeds several looks take than a single one, and how much
a trimmed mean of normal runs loses against their mean."""


def looks(most: int = MOST) -> list[int]:
    """Numbers of seeds at which to look: each half as many more, the last is `most`.

    >>> looks(20), looks(5)
    ([6, 9, 14, 20], [5])
    """
    found = [min(FIRST, most)]
    while found[-1] < most:
        found.append(min(most, math.ceil(1.5 * found[-1])))
    return found


def shares(most: int = MOST) -> dict[int, float]:
    """Seeds of each look -> the error rate that it may spend; they add up to `ALPHA`."""
    return {after: ALPHA * (after**2 - before**2) / most**2 for before, after in pairwise([0, *looks(most)])}


def seeds_needed(variances: np.ndarray, within: float, difference: float = 0.0) -> int:
    """Seeds a side with which a true `difference` is decided in `POWER` of studies: as equivalent if it is 0."""
    for count in range(TRIMMED_FROM, 1000):
        error, freedom = pooled(variances / (EFFICIENCY * count), np.full(2, count - 2 * int(TRIM * count) - 1))
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
    """`seeds_needed` as a range: with both variances of the pilot runs at either end of their 80 % interval.

    A few pilot runs say little about their spread, so the range is wide: that is what it is for.
    """
    squares = np.array([np.var(group, ddof=1) * (len(group) - 1) for group in (baseline, other)])
    freedoms = np.array([len(baseline), len(other)]) - 1
    low, high = (seeds_needed(squares / stats.chi2.ppf(share, freedoms), within, difference) for share in (0.9, 0.1))
    return low, high
