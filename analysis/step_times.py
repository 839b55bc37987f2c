"""Whether the times of runs can be compared: were they measured on the same machine, and under the same load?"""

import pandas as pd

from qnerf.metrics import metric_of

TIMES = ("step_ms", "train_s", "eval_s")
"""Seconds by the clock. They grow with whatever else the machine computes."""

CPU_TIMES = ("step_cpu_ms",)
"""CPU time, which other processes of the machine hardly change."""

LOAD_RATIO = 1.25  # of two loads under which the same step may take that much longer


def incomparable(runs: pd.DataFrame, name: str) -> str:
    """Why the column `name` of the runs is not to be ranked, in a line; empty if it is no time, or comparable.

    Times are comparable on one machine, with one number of threads and of runs side by side, and under loads that
    differ by at most `LOAD_RATIO`. A machine on which every process has a core of its own counts as idle, however many
    there are. Runs of older versions recorded none of this, so they are not.

    >>> runs = pd.DataFrame({"step_ms": [24.0, 31.0], "machine": "a", "time.threads": 2, "time.load": [0.6, 3.1]})
    >>> incomparable(runs, "step_ms")
    'time of a step is not ranked: measured under loads of 0.6 to 3.1 processes for each core'
    >>> incomparable(runs, "psnr")
    ''
    """
    runs = runs[runs[name].notna()] if name in (*TIMES, *CPU_TIMES) else runs[:0]
    if len(runs) < 2:
        return ""
    known = runs.reindex(columns=["machine", "time.threads", "time.load", "time.beside"]).fillna({"time.beside": 1})
    load = known["time.load"].astype(float)
    if missing := int(known.drop(columns="time.load" if name in CPU_TIMES else []).isna().any(axis=1).sum()):
        reason = f"for {missing} of {len(runs)} runs machine, threads or load are unknown"
    elif known["machine"].nunique() > 1:
        reason = f"measured on {known['machine'].nunique()} machines"
    elif known["time.threads"].nunique() > 1:
        reason = f"measured with {', '.join(f'{n:.0f}' for n in sorted(known['time.threads'].unique()))} threads"
    elif known["time.beside"].nunique() > 1:
        reason = (
            f"measured with {', '.join(f'{n:.0f}' for n in sorted(known['time.beside'].unique()))} runs side by side"
        )
    elif name in TIMES and load.clip(lower=1).max() > LOAD_RATIO * load.clip(lower=1).min():
        reason = f"measured under loads of {load.min():.1f} to {load.max():.1f} processes for each core"
    else:
        return ""
    return f"{metric_of(name).label} is not ranked: {reason}"


def incomparable_columns(runs: pd.DataFrame, names: pd.Index | list[str]) -> dict[str, str]:
    """The columns that are not to be ranked, each with the reason."""
    return {name: text for name in names if (text := incomparable(runs, name))}
