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


def logged_keys() -> list[str]:
    """Keys of metrics.parquet whose curves the page shows."""
    held_out = [f"eval/{metric.key}" for metric in quality_metrics()]
    return [*held_out, "train/psnr", "train/loss", "train/mse", "time/step_ms"]


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
        curves = {key: thinned(part) for key, part in logged.groupby("key") if key in logged_keys()}
        if curves:
            result[row] = {key: curves[key] for key in logged_keys() if key in curves}
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
