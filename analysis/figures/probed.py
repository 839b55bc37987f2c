"""Tables that `qnerf probe` left in a run's folder."""

from pathlib import Path

import pandas as pd

from .. import packed


def probed(run: str | Path, name: str) -> pd.DataFrame:
    """A run's `<name>.parquet`. ValueError that says how to make one where there is none."""
    if not packed.has(run, name):
        raise ValueError(f"{run}: has no {name}.parquet; `qnerf probe {Path(run).name} {_argument(name)}` writes it")
    return packed.found(run, name)


def having(frame: pd.DataFrame, name: str) -> pd.DataFrame:
    """The runs with a `<name>.parquet`. ValueError where there is none."""
    kept = frame[[packed.has(path, name) for path in frame["path"]]]
    if kept.empty:
        raise ValueError(f"none of {len(frame)} runs has {name}.parquet; `qnerf probe RUN {_argument(name)}` writes it")
    return kept


def best_of(frame: pd.DataFrame, name: str) -> str:
    """The folder of the run of highest PSNR that has a `<name>.parquet`."""
    kept = having(frame, name)
    return str(kept.sort_values("psnr", ascending=False)["path"].iloc[0])


def _argument(name: str) -> str:
    return "shots=100,1000" if name == "eval_hardware" else name
