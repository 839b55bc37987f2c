"""The repository's folders, and real configurations composed as the command line composes them."""

import copy
import functools
import io
from pathlib import Path
from typing import Any
from unittest.mock import patch

from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from qnerf.building.configuration import Configuration
from qnerf.cli.compose import translated
from qnerf.cli.resolvers import HYDRA

ROOT = Path(__file__).parents[2]
CONF = ROOT / "conf"
SWEEPS = ROOT / "sweeps"

TINY = (
    "sampler.samples=[8,6]",
    "sampler.final=4",
    "sampler.levels=2",
    "sampler.log2_table_size=6",
    "sampler.max_resolutions=[24,32]",
)
"""A proposal sampler small enough for a unit test."""

MOMENT = (
    "hash=C7",
    "train.steps=2",
    "train.rays=8",
    "train.eval_every=0",
    "train.log_every=1",
    "visibility.resolution=16",
    "device=cpu",
)
"""Two steps of training, of a moment."""


def composed(*overrides: str, sweep: str = "") -> dict[str, Any]:
    """The resolved configuration that these overrides give on the command line, `-cd sweeps -cn sweep` where named."""
    return OmegaConf.to_container(_compose(overrides, sweep), resolve=True)


def worked_out(*overrides: str, sweep: str = "") -> Configuration:
    """What `composed` gives, checked: the options that act."""
    return Configuration.of(composed(*overrides, sweep=sweep))


def swept(sweep):
    """What a file of sweeps/ sweeps over: option -> its values as the command line would give them."""
    return {key: str(values) for key, values in _compose((), sweep, hydra=True).hydra.sweeper.params.items()}


def _compose(overrides, sweep, hydra=False):
    search = [f"hydra.searchpath=[file://{CONF}]"] if sweep else []
    folder = str(SWEEPS if sweep else CONF)
    with initialize_config_dir(folder, **HYDRA), patch.object(OmegaConf, "load", _load):
        return compose(sweep or "config", [*map(translated, overrides), *search], return_hydra_config=hydra)


def _load(file):
    """`OmegaConf.load` that parses each text once: compositions read two dozen files each, mostly the same ones."""
    return copy.deepcopy(_parsed(file.read()))


@functools.cache
def _parsed(text, load=OmegaConf.load):
    return load(io.StringIO(text))
