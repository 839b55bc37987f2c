"""One table of all runs of a store, which reads only what changed since it was last asked for."""

from qnerf.records.index.table import OWN, Progress, columns, load, place_of

__all__ = ["OWN", "Progress", "columns", "load", "place_of"]
