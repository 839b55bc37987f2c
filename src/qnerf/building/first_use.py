"""The first run with circuits in a new environment: two processes compile its loops at the same time.

Numba compiles in one thread. So a second process takes a step with MLPs on a tiny scene, which compiles everything that
is no circuit, while this process reads the scene and compiles the circuits. Both find each other's machine code in
Numba's cache.
"""

import contextlib
import copy
import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import torch
from torch import nn

from qnerf.building.model import build_model, ray_table
from qnerf.building.scene import prepare
from qnerf.kernels import grid_mlp
from qnerf.kernels.jit import is_cached, keeps
from qnerf.model.model import Model
from qnerf.quantum import QuantumLayer
from qnerf.quantum.compiled import sweeps
from qnerf.timing import Stopwatch
from qnerf.training.trainer import Trainer

PATIENCE = 120.0  # seconds for the second process, once this one waits for it
SAMPLES = 32  # on which circuits are run
SCENE = {"name": "poster", "views": 10, "width": 8, "height": 8, "supersample": 1, "seed": 0}


@contextlib.contextmanager
def two_processes(config: Mapping[str, Any]) -> Iterator[Callable[[Model], None]]:
    """Yields what to call once the model is built: it returns when all loops are compiled.

    It does nothing unless the usual loops are needed, have never been compiled here, and there is a second processor.
    If the second process fails, the first step compiles what is missing.
    """
    process = None
    new = keeps(sweeps.forward) and not any(map(is_cached, (sweeps.forward, grid_mlp._forward)))
    if new and usual(config) and torch.get_num_threads() > 1:
        with contextlib.suppress(OSError, TypeError, ValueError):  # no process, or a mistake that is reported later
            process = start(json.dumps(config))
    try:
        yield partial(finish, process)
    finally:
        if process is not None:
            process.kill()
            process.wait()


def usual(config: Mapping[str, Any]) -> bool:
    """Whether the configuration trains exact QIREN heads on a hash grid, on the CPU and without plugins."""
    with contextlib.suppress(KeyError, TypeError, AttributeError):
        heads = [config[group] for group in ("density", "color")]
        circuits = [head["qiren"] for head in heads if head["name"] == "qiren"]
        exact = all(c["method"] == "auto" and c["shots"] is None and not any(c["noise"].values()) for c in circuits)
        alone = config["device"] != "cuda" and not torch.cuda.is_available() and not config["plugins"]
        known = (config["encoder"]["name"], config["sampler"]["name"]) == ("hash", "proposal")
        return bool(circuits) and exact and alone and known and config["threads"] != 1
    return False  # a mistake that is reported later


def start(config: str) -> subprocess.Popen:
    """The second process, which has read its configuration."""
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", __spec__.name],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert process.stdin is not None
    with contextlib.suppress(OSError), process.stdin:  # it has ended already
        process.stdin.write(config)
    return process


def finish(process: subprocess.Popen | None, model: Model) -> None:
    """Compiles the model's circuits while the process compiles the rest."""
    if process is None:
        return
    compile_circuits(model)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(PATIENCE)


def compile_circuits(model: nn.Module) -> None:
    """Runs the loops of the model's exact circuits once, forward and back, and changes nothing in the model."""
    for layer in [module for module in model.modules() if isinstance(module, QuantumLayer)]:
        weight = next(layer.parameters())
        angles = torch.zeros(SAMPLES, layer.wires, dtype=weight.dtype, requires_grad=True)
        copy.deepcopy(layer)(angles).sum().backward()


def main() -> None:
    """The second process. Its configuration is on standard input."""
    config = json.load(sys.stdin)
    heads = {group: config[group] | {"name": "mlp"} for group in ("density", "color")}
    train = config["train"] | {"rays": SAMPLES}
    _, settings, scene = prepare(config | heads | {"scene": SCENE, "train": train})
    model = build_model(settings, scene)
    watch = Stopwatch(settings.torch_device, model, QuantumLayer)
    Trainer(model, ray_table(settings, scene), settings, watch).take_step(measure=False)


if __name__ == "__main__":
    main()
