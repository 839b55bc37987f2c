"""What the circuits of a run would cost on quantum hardware, where each expectation value takes shots."""

import copy
from collections import Counter
from contextlib import ExitStack
from typing import Any

import pandas as pd
import torch
from torch import Tensor, nn

from qnerf.model.model import Model
from qnerf.probes.trained import Trained, circuits_of, heads_of
from qnerf.quantum.circuit import Circuit, Encoding, Entangler, Rotations
from qnerf.rendering.background import evaluation_background

SHOTS = 1000  # of each circuit
RATE = 10_000.0  # shots a second
RAYS = 256


def table(trained: Trained) -> pd.DataFrame:
    """One row for each circuit of each head.

    Columns: head: density or color; circuit: 0, 1, ...; wires; one_qubit_gates, two_qubit_gates and depth, see
    `gate_counts`; view: evaluations of the circuit for one held-out view, all outputs read in the same shots;
    step: evaluations for one training step with the parameter-shift rule; view_hours, step_hours: their time at `SHOTS`
    shots an evaluation and `RATE` shots a second. Sending circuits to the device is not counted.

    Raises:
        ValueError: the run has no circuit.
    """
    layers = {
        (name, place): layer for name, head in trained.heads.items() for place, layer in circuits_of(head).items()
    }
    if not layers:
        raise ValueError(f"{trained.folder}: neither of its heads has a re-uploading circuit")
    rays = trained.ray_table()
    in_view = samples(trained, trained.model)
    in_step = samples(trained, copy.deepcopy(trained.model).train())  # a copy: its normalisations learn statistics
    rows: list[dict[str, Any]] = []
    for (name, place), layer in layers.items():
        one, two, depth = gate_counts(layer.circuit)
        view = round(in_view[name, place] * rays.cameras.width * rays.cameras.height / RAYS)
        step = round(in_step[name, place] * trained.settings.train.rays / RAYS) * shifts(layer.circuit)
        rows.append(
            {
                "head": name,
                "circuit": sum(row["head"] == name for row in rows),
                "wires": layer.wires,
                "one_qubit_gates": one,
                "two_qubit_gates": two,
                "depth": depth,
                "view": view,
                "step": step,
                "view_hours": view * SHOTS / RATE / 3600,
                "step_hours": step * SHOTS / RATE / 3600,
            }
        )
    return pd.DataFrame(rows)


def gate_counts(circuit: Circuit) -> tuple[int, int, int]:
    """One-qubit gates, two-qubit gates, and depth in gates.

    A Rot is one gate here; devices with virtual RZ take two pulses for it. Gates on different wires run side by side.

    >>> from qnerf.quantum.circuit import ANSATZE
    >>> gate_counts(ANSATZE.build("qiren", 3, 1))
    (15, 12, 17)
    """
    one, two, ready = 0, 0, [0] * circuit.wires
    for operation in circuit.operations:
        if isinstance(operation, Entangler):
            for pair in operation.pairs:
                two += 1
                first, second = pair
                ready[first] = ready[second] = max(ready[first], ready[second]) + 1
        else:
            one += circuit.wires
            ready = [time + 1 for time in ready]
    return one, two, max(ready)


def shifts(circuit: Circuit) -> int:
    """Evaluations for the outputs of one sample and all their derivatives: one, and two for each angle that varies."""
    angles = sum(3 * circuit.wires for operation in circuit.operations if isinstance(operation, Rotations))
    inputs = sum(circuit.wires for operation in circuit.operations if isinstance(operation, Encoding))
    return 1 + 2 * (angles + inputs)


@torch.no_grad()
def samples(trained: Trained, model: Model) -> Counter[tuple[str, str]]:
    """Head and place of each circuit -> samples that it gets for `RAYS` training rays."""
    rays, _ = trained.ray_table().batch(RAYS, torch.Generator().manual_seed(0), model.cameras)
    seen: Counter[tuple[str, str]] = Counter()
    with ExitStack() as hooks:
        for name, head in heads_of(model).items():
            for place, layer in circuits_of(head).items():

                def count(_: nn.Module, inputs: tuple[Tensor, ...], out: Tensor, key: Any = (name, place)) -> None:
                    seen[key] += out.shape[:-1].numel()

                hooks.callback(layer.register_forward_hook(count).remove)
        background = evaluation_background(trained.settings.render.background)
        model(rays, background=background, step=trained.step, watch=trained.stopwatch(model))
    return seen
