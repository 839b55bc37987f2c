"""Tables that `qnerf probe` writes into a run's folder."""

from pathlib import Path

import pandas as pd

from .. import packed


def probed(run: str | Path, name: str) -> pd.DataFrame:
    """A run's `<name>.parquet`. If it does not exist, the ValueError names the command that writes it."""
    table = packed.probe_table(run, name)
    if table is None:
        raise ValueError(f"{run}: has no {name}.parquet; {command(name, Path(run).name)} writes it")
    return table


def having(frame: pd.DataFrame, name: str) -> pd.DataFrame:
    """The runs that have a readable `<name>.parquet`. Raises ValueError with the command that writes it if none has."""
    tables, damaged = packed.probe_tables(frame["path"], name)
    if not tables:
        raise ValueError(damaged or f"no run of {len(frame)} has {name}.parquet; {command(name)} writes it")
    return frame[frame["path"].isin(list(tables))]


def best_of(frame: pd.DataFrame, name: str) -> str:
    """The folder of the run of highest PSNR that has a readable `<name>.parquet`."""
    return str(having(frame, name).sort_values("psnr", ascending=False)["path"].iloc[0])


def command(name: str, run: str = "RUN") -> str:
    """The command that writes a run's `<name>.parquet`."""
    return f"`qnerf probe {run} {'shots=100,1000' if name == 'eval_hardware' else name}`"
