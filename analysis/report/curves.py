"""Logged values of the runs, thinned for the page."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas as pd

from qnerf.metrics import quality_metrics

from ..load import metrics
from .columns import rounded_all

MAX_RUNS = 300
POINTS = 80
DETAILS = ("time/", "train/distortion", "train/interlevel", "train/lr")
"""What every training of qnerf logs, and only the live page shows."""


def arranged(keys: Iterable[str]) -> list[str]:
    """Keys of metrics.parquet in the order in which a page offers them: the usual ones, then the others."""
    found = set(keys)
    held_out = [f"eval/{metric.key}" for metric in quality_metrics()]
    usual = [
        key
        for key in ("train/loss", "loss", held_out[0], "train/psnr", *held_out[1:], "train/mse", "time/step_ms")
        if key in found
    ]
    return [*usual, *sorted(found.difference(usual))]


def gather(frame: pd.DataFrame, order: Iterable[int], *, max_runs: int = MAX_RUNS) -> dict[int, dict[str, Any]]:
    """Row number -> key -> {step, time, value} of at most `max_runs` runs that have readable metrics."""
    result: dict[int, dict[str, Any]] = {}
    for row in order:
        if len(result) == max_runs:
            break
        try:
            logged = metrics(frame["path"].iloc[row])
        except ValueError:  # no metrics yet, or damaged ones
            logged = pd.DataFrame({"key": []})
        parts = {str(key): part for key, part in logged.groupby("key")}
        if shown := [key for key in parts if key == "time/step_ms" or not key.startswith(DETAILS)]:
            result[row] = {key: thinned(parts[key]) for key in shown}
    return result


def thinned(logged: pd.DataFrame, points: int = POINTS) -> dict[str, list[float | int | None]]:
    """Columns step, time_s (seconds) and value as means over up to `points` spans of equally many logged rows.

    A span stands at its last step and time, and has no value where a value is NaN. Every row stays where there are no
    more than `points`.
    """
    first = np.arange(0, len(logged), -(-len(logged) // points))
    end = np.append(first[1:], len(logged))
    return {
        "step": rounded_all(logged["step"].to_numpy()[end - 1], 9),
        "time": rounded_all(logged["time_s"].to_numpy()[end - 1], 4),
        "value": rounded_all(np.add.reduceat(logged["value"].to_numpy(float), first) / (end - first), 5),
    }
