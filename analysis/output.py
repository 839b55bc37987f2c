"""Folders of the user in which the commands of `analysis` write."""

from pathlib import Path

from qnerf.records.deletion import holds_runs, refuse_runs


def make_folder(folder: Path, *, store: bool = True) -> None:
    """Makes the folder and those above it.

    store: whether it may be one that holds runs.

    Raises:
        ValueError: the folder is a run's, or in one, or a store.
    """
    refuse_runs(folder)
    if not store and holds_runs(folder):
        raise ValueError(f"{folder}: expected a folder of its own, this is one of runs")
    folder.mkdir(parents=True, exist_ok=True)
