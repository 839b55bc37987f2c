"""A trainer of a configuration, without a store."""

from qnerf.building.model import build_model, ray_table
from qnerf.building.scene import build_scene
from qnerf.config.settings import settings_from
from qnerf.quantum import QuantumLayer
from qnerf.timing import Stopwatch
from qnerf.training.trainer import Trainer


def trainer(config) -> Trainer:
    settings = settings_from(config)
    scene = build_scene(settings)
    model = build_model(settings, scene)
    watch = Stopwatch(settings.torch_device, model, QuantumLayer)
    return Trainer(model, ray_table(settings, scene), settings, watch)
