"""Which runs a command line names, without training them."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from qnerf.building.scene import prepare
from qnerf.cli.compose import configuration


def run_ids(overrides: Sequence[str], seeds: Iterable[int], store: str | Path) -> list[str]:
    """The ids of the runs that `qnerf run` with these overrides and each seed has in the store.

    The scene is read once. ValueError where the configuration is not valid or the scene cannot be read.
    """
    own = [item for item in overrides if not item.startswith("hydra")]
    source, names = None, []
    for seed in seeds:
        prepared = prepare(configuration([*own, f"seed={seed}"]), source)
        source = prepared.source
        names.append(prepared.find_id(store))
    return names
