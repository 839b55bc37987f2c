"""`qnerf replay FILE [--scene DIR] [--device cpu]`."""

import argparse
from pathlib import Path

from qnerf.cli.commands import add_plugins
from qnerf.cli.upgrade_config import fill
from qnerf.config.compatibility import upgrade_config
from qnerf.records.printable import printable


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Repeats the training step in which numerics.finite_checks=true found a value that is not finite. "
        "Exit code 1: it happens again; 0: all values are finite; 2: the step cannot be repeated."
    )
    parser.add_argument("file", type=Path, metavar="FILE", help="nonfinite.pt in the run's folder")
    add_plugins(parser)
    parser.add_argument("--scene", metavar="DIR", help="where the scene is now (default: scene.path of the run)")
    parser.add_argument("--device", choices=["auto", "cpu", "cuda"], help="default: the device of the run")


def main(options: argparse.Namespace) -> int:
    import torch

    from qnerf.building.model import build_model, ray_table
    from qnerf.building.scene import prepare
    from qnerf.quantum import QuantumLayer
    from qnerf.timing import Stopwatch
    from qnerf.training.checked_trainer import CheckedTrainer, ReplayTable, RunContext, load_step
    from qnerf.training.finite_checks import NonFinite

    content = load_step(options.file)
    config = upgrade_config(content["config"])
    fill(config, options.file, options.plugins)
    if options.scene is not None:
        config["scene"]["path"] = options.scene
    if options.device is not None:
        config["device"] = options.device
    _, settings, scene = prepare(config)
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    model = build_model(settings, scene)
    table = ReplayTable(ray_table(settings, scene), content["rays"], content["colors"])
    watch = Stopwatch(settings.torch_device, model, QuantumLayer)
    trainer = CheckedTrainer(model, table, settings, watch, RunContext(scene.names, config, None))
    trainer.load(content["state"], finite=False)  # a value that is not finite may be what is looked for
    print(printable(f"then: {content['told']}"))
    try:
        trainer.take_step(measure=False)
    except NonFinite as error:
        print(printable(f"now:  {error.message}"))
        print("the same" if error.message == content["told"] else "not the same")
        return 1
    print("now:  every value is finite; it does not occur here")
    return 0
