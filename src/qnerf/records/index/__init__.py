"""One table of all runs of a store. It reads only the files that changed since the last time."""

from qnerf.records.index.table import RUN_COLUMNS, Progress, columns, load, load_runs, locate

__all__ = ["RUN_COLUMNS", "Progress", "columns", "load", "load_runs", "locate"]
