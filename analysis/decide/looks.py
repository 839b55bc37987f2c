"""Looking several times at the same comparison, without more than `ALPHA` wrong verdicts over all looks.

Look k at n_k seeds a side spends ALPHA (n_k^2 - n_(k-1)^2) / most^2. The shares add up to ALPHA, so by the union bound
no more than that is wrong wherever one stops. `most`, the last look, is fixed once the first runs show what one costs.
"""

import math
from itertools import pairwise

from ..verdict import ALPHA

FIRST, MOST = 6, 20


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
