"""A trainer of a configuration, without a store."""

from typing import Any

import torch

from qnerf.building.acting import settings_of
from qnerf.building.model import build_model, ray_table
from qnerf.quantum import QuantumLayer
from qnerf.timing import Stopwatch
from qnerf.training.trainer import Trainer
from tests.helpers.scenes import build_scene


def trainer(config) -> Trainer:
    settings = settings_of(config)
    scene = build_scene(settings)
    model = build_model(settings, scene)
    watch = Stopwatch(settings.torch_device, model, QuantumLayer)
    return Trainer(model, ray_table(settings, scene), settings, watch)


def same(one: Any, other: Any) -> bool:
    """Whether two values are bit-equal, also tensors in containers."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(same, one, other))
    return torch.equal(one, other) if isinstance(one, torch.Tensor) else one == other
