"""Dead units of the heads, and how much each layer's values vary over the scene."""

from collections.abc import Iterator

import pandas as pd
import torch
from torch import nn

from qnerf.building.model import build_model
from qnerf.model.model import Model
from qnerf.probes.trained import Trained, heads_of
from qnerf.quantum import QuantumLayer

RAYS = 1024


def table(trained: Trained) -> pd.DataFrame:
    """One row for each layer of each head, before training and after, on 1,024 training rays.

    Columns: when: start (built from the run's own seed) or end; head: density or color; layer: 0, 1, ...; kind: relu,
    circuit, or output for the head's raw values; units; dead: the share of ReLU units that are 0 on all samples, NaN
    for other kinds; std: the standard deviation over the samples, as a root mean square over the units.
    """
    fresh = build_model(trained.settings, trained.scene)
    parts = []
    for when, model, step in (("start", fresh, 0), ("end", trained.model, trained.step)):
        parts += [{"when": when, **row} for row in _measured(trained, model, step)]
    return pd.DataFrame(parts).astype({"dead": "float64"})


def _measured(trained: Trained, model: Model, step: int) -> Iterator[dict[str, object]]:
    """The rows of one model. A fresh one is in training mode, because its normalisations have no statistics yet."""
    layers = {
        (name, number): module
        for name, head in heads_of(model).items()
        for number, module in enumerate(
            [*(module for module in head.modules() if isinstance(module, (nn.ReLU, QuantumLayer))), head]
        )
    }
    outputs = trained.watched(model, layers, lambda _, out: out.clone(), RAYS, step)  # the next layer may work in place
    for (name, number), module in layers.items():
        values = torch.cat([out.double().reshape(-1, out.shape[-1]) for out in outputs[name, number]])
        kind = {nn.ReLU: "relu", QuantumLayer: "circuit"}.get(type(module), "output")
        dead = float((values <= 0).all(0).double().mean()) if kind == "relu" else None
        std = float(values.var(0, unbiased=False).mean().sqrt())
        yield {"head": name, "layer": number, "kind": kind, "units": values.shape[-1], "dead": dead, "std": std}
