"""Which runs a command line names, without training them."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import hydra
from omegaconf import OmegaConf

from qnerf.building.scene import prepare
from qnerf.cli.compose import translated
from qnerf.cli.resolvers import HYDRA
from qnerf.config.folders import CONF


def run_ids(overrides: Sequence[str], seeds: Iterable[int], store: str | Path) -> list[str]:
    """The ids of the runs that `qnerf run` with these overrides and each seed has in the store.

    The scene is read once. ValueError where the configuration is not valid or the scene cannot be read.
    """
    own = [translated(item) for item in overrides if not item.startswith("hydra")]
    scene, names = None, []
    for seed in seeds:
        with hydra.initialize_config_dir(str(CONF), **HYDRA):
            composed = hydra.compose("config", [*own, f"seed={seed}"])
        config: Any = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)
        prepared = prepare(config, scene)
        scene = scene or prepared.scene
        names.append(prepared.find_id(store))
    return names
