"""Mean and spread over the seeds of each group of runs."""

from collections.abc import Sequence

import pandas as pd

from qnerf.metrics import METRICS, metric_of

from ..selection import select


def values_of(runs: pd.DataFrame, metric: str, asked: Sequence[str] | None) -> list[str]:
    """`asked` if all of them are numbers of the runs; else the metrics that the runs have."""
    if asked is None:
        usual = [name for name, item in METRICS.items() if not item.on_request]
        return [name for name in dict.fromkeys([*usual, metric]) if name in runs.columns and _is_given(name, runs)]
    for name in asked:
        select(runs, name)  # refuses what is not there
    return list(dict.fromkeys(asked))


def aggregate(runs: pd.DataFrame, rows: Sequence[str], values: Sequence[str]) -> pd.DataFrame:
    """The groups in the order of their keys, as `groupby` numbers them."""
    groups = runs.groupby(list(rows), dropna=False)
    table = groups[list(values)].agg(["mean", "std", "count"]).rename(columns={"count": "n"}, level=1)
    table[("seeds", "n")] = groups.size()
    return table


def _is_given(name: str, runs: pd.DataFrame) -> bool:
    given = runs[name].notna().any()
    optional = name in ("params.sampler", "params.cameras", "params.appearance")
    return bool(given and (not optional or runs[name].any()))


def mean_and_spread(name: str, mean: float, std: float, n: int, seeds: int) -> str:
    """`26.00 ± 0.48`; one seed has no spread, and `(n = 2)` says that only 2 of the row's seeds have the value."""
    if pd.isna(mean):
        return ""
    text = metric_of(name).text
    spread = "" if metric_of(name).kind == "size" or pd.isna(std) else f" ± {text(std)}"
    return text(mean) + spread + (f" (n = {n})" if n < seeds else "")
