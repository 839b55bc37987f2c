"""The ablation table: a row a configuration, best in bold, with the difference from a baseline row."""

from collections.abc import Mapping, Sequence

import pandas as pd

from qnerf.metrics import metric_of

from ..selection import SCENES, label, select
from ..step_times import incomparable_columns
from ..verdict import Verdict, within_of
from .differences import against, as_numbers, interval
from .seeds import aggregate, mean_and_spread, values_of
from .table import Table


def ablation(
    frame: pd.DataFrame,
    rows: Sequence[str],
    *,
    metric: str = "psnr",
    values: Sequence[str] | None = None,
    baseline: str | Mapping[str, object] | None = None,
    within: float | None = None,
    title: str | None = None,
) -> Table:
    """Mean ± standard deviation over seeds, a row each group of `rows`; the best of each scene in bold.

    baseline: conditions on the row keys that exactly one row meets (one a scene, where scenes are among the rows); see
    `qnerf.records.filters`. The other rows then show their `metric` minus the baseline's with its interval, in the
    metric's unit, and the verdict. within: the smallest difference that matters; the metric may have one of its own.
    values: the metrics that the runs have, unless given. Columns of `data` are (value, "mean" | "std" | "n"), ("seeds",
    "n") and, with a baseline, ("difference", ...), in the values' own units. Raises ValueError as `select` does, for
    unknown values, for a baseline that matches no row or several, and with a baseline for infinite values.
    """
    selection = select(frame, metric, rows)
    runs = selection.runs
    table = aggregate(runs, rows, values_of(runs, metric, values))
    notes = [selection.note]
    verdicts = None
    if baseline is not None:
        if infinite := selection.left_out.get(f"infinite {metric}"):
            raise ValueError(f"{metric} of {infinite} runs is infinite: compare another metric, or leave them out")
        keys = table.index.to_frame(index=False)
        verdicts, remarks = against(runs, rows, keys, baseline, metric, within_of(metric, within, 0))
        notes += remarks
    unranked = incomparable_columns(runs, table.columns.get_level_values(0).unique())
    return compose(table, verdicts, title or f"{metric_of(metric).heading} over seeds", notes, metric, unranked)


def compose(
    table: pd.DataFrame,
    verdicts: Sequence[Verdict | None] | None,
    title: str,
    notes: Sequence[str],
    metric: str,
    unranked: Mapping[str, str],
) -> Table:
    """The shown table of `aggregate`'s numbers and, where there is a baseline, the `verdicts` against it.

    unranked: values without a best row, and why.
    """
    names = [name for name in table.columns.get_level_values(0).unique() if name != "seeds"]
    seeds = table[("seeds", "n")]
    text = pd.DataFrame({name: table.index.get_level_values(name).map(label) for name in table.index.names})
    bold = pd.DataFrame(index=text.index)
    for place, name in enumerate(sorted(names, key=lambda name: name != metric)):
        column = table[name]
        numbers = zip(column["mean"], column["std"], column["n"], seeds, strict=True)
        text[metric_of(name).heading] = [mean_and_spread(name, *row) for row in numbers]
        bold[metric_of(name).heading] = False if name in unranked else best(table, name).to_numpy()
        if place == 0 and verdicts is not None:
            heading = f"difference, {metric_of(metric).heading}"
            text[heading] = ["" if found is None else interval(found, metric) for found in verdicts]
            text["verdict"] = ["" if found is None else found.text(metric) for found in verdicts]
        if place == 0:
            text["seeds"] = seeds.map("{:d}".format).to_numpy()
    if verdicts is not None:
        table = table.join(pd.concat({"difference": as_numbers(verdicts).set_index(table.index)}, axis=1))
    single = int((seeds == 1).sum())
    remark = f"n = 1 in {single} of {len(seeds)} rows: no spread" if single else ""
    return Table(title, text, table, bold, (*notes, remark, *unranked.values()))


def best(table: pd.DataFrame, name: str) -> pd.Series:
    """True where the mean of `name` prints like the best of its scene; nowhere if all print the same."""
    item, means = metric_of(name), table[(name, "mean")]
    if item.better is None:
        return pd.Series(False, index=table.index)
    printed = means.map(item.text, na_action="ignore")
    scenes = [key for key in table.index.names if key in SCENES]
    scene = table.index.to_frame()[scenes].apply(tuple, axis=1) if scenes else pd.Series(0, index=table.index)
    winners = (item.sign * (item.sign * means).groupby(scene).transform("max")).map(item.text, na_action="ignore")
    return (printed == winners) & (printed.groupby(scene).transform("nunique") > 1)
