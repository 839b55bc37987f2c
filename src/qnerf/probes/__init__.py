"""Probes: tables computed from a trained model and saved in its run's folder as `<probe>.parquet`."""

from collections.abc import Callable
from pathlib import Path

import pandas as pd

from qnerf.probes import cost, diagnostics, spectrum, units
from qnerf.probes.trained import Trained, load, require_loadable
from qnerf.records.files import replace

PROBES: dict[str, Callable[[Trained], pd.DataFrame]] = {
    "spectrum": spectrum.table,
    "units": units.table,
    "cost": cost.table,
    "expressibility": diagnostics.expressibility,
    "entangling": diagnostics.entangling,
    "fisher": diagnostics.fisher,
    "kernel": diagnostics.kernel,
    "surrogate": diagnostics.surrogate,
}


def probe(trained: Trained, name: str) -> Path:
    """Computes a probe, replaces `<name>.parquet` in the run's folder and returns its path.

    Raises:
        ValueError: an unknown probe, or one that the run has no parts for (a spectrum or a cost without circuits).
    """
    if name not in PROBES:
        raise ValueError(f"unknown probe {name!r}; known: {', '.join(PROBES)}")
    path = trained.folder / f"{name}.parquet"
    replace(path, PROBES[name](trained).to_parquet(index=False))
    return path


__all__ = ["PROBES", "Trained", "load", "probe", "require_loadable"]
