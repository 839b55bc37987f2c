"""A model, its scene and a trainer from a configuration, without a store."""

from typing import NamedTuple

import torch

from qnerf.building.model import build_model, ray_table
from qnerf.building.scene import prepare
from qnerf.config.settings import Settings
from qnerf.geometry.rays import RayTable
from qnerf.model.model import Model
from qnerf.quantum import QuantumLayer
from qnerf.scenes import Scene
from qnerf.timing import Stopwatch
from qnerf.training.trainer import Trainer


class Built(NamedTuple):
    """What a configuration describes."""

    settings: Settings
    scene: Scene
    model: Model
    table: RayTable
    watch: Stopwatch


def built(config):
    settings, scene = prepare(config).of_field()
    model = build_model(settings, scene)
    watch = Stopwatch(settings.torch_device, model, QuantumLayer)
    return Built(settings, scene, model, ray_table(settings, scene), watch)


def trainer(config):
    settings, _, model, table, watch = built(config)
    return Trainer(model, table, settings, watch)


def same(one, other):
    """Whether two values are bit-equal, also tensors in containers."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(same, one, other))
    return torch.equal(one, other) if isinstance(one, torch.Tensor) else one == other
