"""How alive heads are: which hidden units never act, and how much a head's values vary over the scene."""

from collections.abc import Iterator
from contextlib import ExitStack
from itertools import chain

import pandas as pd
import torch
from torch import Tensor, nn

from qnerf.experiment import build_model, ray_table
from qnerf.model.model import Model
from qnerf.probes.trained import Trained
from qnerf.quantum import QuantumLayer
from qnerf.rendering.background import evaluation_background
from qnerf.timing import Stopwatch

RAYS = 1024


def table(trained: Trained) -> pd.DataFrame:
    """One row for each layer of each head, before training and after, on 1,024 training rays.

    Columns: when: start (the run's own seed) or end; head: density or color; layer: 0, 1, ...; kind: relu, circuit, or
    output for the head's raw values; units; dead: share of ReLU units that are 0 on all samples, NaN for the others;
    std: root mean square over the units of their standard deviation over the samples.
    """
    fresh = build_model(trained.settings, trained.scene)
    fresh.field.encoder.progress = 0.0
    parts = []
    for when, model, step in (("start", fresh, 0), ("end", trained.model, trained.step)):
        parts += [{"when": when, **row} for row in _measured(trained, model, step)]
    return pd.DataFrame(parts).astype({"dead": "float64"})


@torch.no_grad()
def _measured(trained: Trained, model: Model, step: int) -> Iterator[dict[str, object]]:
    """A fresh model is measured in training mode: its normalisations know no statistics yet."""
    settings = trained.settings
    rays, _ = ray_table(settings, trained.scene).batch(RAYS, torch.Generator().manual_seed(0), model.cameras)
    seen: dict[nn.Module, list[Tensor]] = {}
    heads = {"density": model.field.density_head, "color": model.field.color_head}
    layers = {
        name: [*(module for module in head.modules() if isinstance(module, (nn.ReLU, QuantumLayer))), head]
        for name, head in heads.items()
    }

    def note(module: nn.Module, _: tuple[Tensor, ...], out: Tensor) -> None:
        seen.setdefault(module, []).append(out.clone())  # the next layer may work in place

    with ExitStack() as hooks:
        for module in chain(*layers.values()):
            hooks.callback(module.register_forward_hook(note).remove)
        background = evaluation_background(settings.render.background)
        watch = Stopwatch(settings.torch_device, model, QuantumLayer)
        model(rays, background=background, step=step, watch=watch)
    for name, modules in layers.items():
        for number, module in enumerate(modules):
            values = torch.cat(seen[module]).double().reshape(-1, seen[module][0].shape[-1])
            kind = {nn.ReLU: "relu", QuantumLayer: "circuit"}.get(type(module), "output")
            dead = float((values <= 0).all(0).double().mean()) if kind == "relu" else None
            std = float(values.var(0, unbiased=False).mean().sqrt())
            yield {"head": name, "layer": number, "kind": kind, "units": values.shape[-1], "dead": dead, "std": std}
