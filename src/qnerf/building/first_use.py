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
from typing import Any

import torch
from torch import nn

from qnerf.building.model import build_model, ray_table
from qnerf.building.scene import prepare
from qnerf.heads.base import chosen
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

    It does nothing unless the configuration has circuits, their loops have never been compiled here, and a second
    processor is there. If the second process fails, the first step compiles what is missing.
    """
    circuits = any(chosen(config[group]).quantum for group in ("density", "color"))
    new = keeps(sweeps.forward) and not any(map(is_cached, (sweeps.forward, grid_mlp._forward)))
    if not circuits or not new or torch.get_num_threads() == 1:
        yield lambda model: None
        return
    process = subprocess.Popen(
        [sys.executable, "-m", __spec__.name],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    with process:
        try:
            with contextlib.suppress(OSError):  # it has ended already
                assert process.stdin is not None
                process.stdin.write(json.dumps(config))
                process.stdin.close()

            def finish(model: Model) -> None:
                compile_circuits(model)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(PATIENCE)

            yield finish
        finally:
            process.kill()


def compile_circuits(model: nn.Module) -> None:
    """Runs the loops of the model's circuits once, forward and back, and changes nothing in the model."""
    for layer in [module for module in model.modules() if isinstance(module, QuantumLayer)]:
        weight = next(layer.parameters())
        angles = torch.zeros(SAMPLES, layer.wires, dtype=weight.dtype, device=weight.device, requires_grad=True)
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
