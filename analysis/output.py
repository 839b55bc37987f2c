"""Folders of the user in which the commands of `analysis` write."""

from pathlib import Path

from qnerf.records.deletion import holds_runs, refuse_runs


def make_folder(folder: Path, *, store: bool = True) -> None:
    """Makes the folder and those above it; ValueError for one of a run, or without `store` for one that holds runs."""
    refuse_runs(folder)
    if not store and holds_runs(folder):
        raise ValueError(f"{folder}: expected a folder of its own, this is one of runs")
    folder.mkdir(parents=True, exist_ok=True)
