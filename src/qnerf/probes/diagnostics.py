"""Diagnostics of a run's circuits, see `qnerf.quantum.diagnostics`: what they can express, and how they learn."""

from collections.abc import Iterator, Mapping
from typing import Any

import pandas as pd
import torch
from torch import Tensor, nn

from qnerf.probes.trained import Trained
from qnerf.quantum import QuantumLayer, diagnostics

RAYS = 2048
STATES = 2000
FISHER_INPUTS = 32
FISHER_POINTS = 4  # of random weights
KERNEL_INPUTS = 128
SAMPLES = 6000  # of a surrogate, two thirds of them fitted
WAVES = (8, 32, 128, 512)


def expressibility(trained: Trained) -> pd.DataFrame:
    """Two rows for each circuit. Columns head, circuit (0, 1, ...), weights, expressibility (nats), haar, pairs.

    weights: `random` for all states that the circuit can make, at uniform inputs; `trained` for those that it makes of
    the run's samples. haar is about what random states would give with so many pairs.
    """
    rows = []
    for row, layer, x in _circuits(trained):
        for weights, inputs in (("random", None), ("trained", x)):
            pairs = STATES // 2 if layer.wires > 10 else 5000
            value = diagnostics.expressibility(layer, pairs=pairs, x=inputs, trained=weights == "trained")
            haar = (diagnostics.BINS - 1) / (2 * pairs)
            rows.append(row | {"weights": weights, "expressibility": value, "haar": haar, "pairs": pairs})
    return pd.DataFrame(rows)


def entangling(trained: Trained) -> pd.DataFrame:
    """Two rows for each circuit, as in `expressibility`. Columns head, circuit, weights, entanglement, standard_error,
    haar: mean Meyer-Wallach entanglement of the states, and of random states, (2^n - 2) / (2^n + 1).
    """
    rows = []
    for row, layer, x in _circuits(trained):
        for weights, inputs in (("random", None), ("trained", x)):
            found = diagnostics.entangling_capability(layer, states=STATES, x=inputs, trained=weights == "trained")
            values = {"entanglement": found.mean, "standard_error": found.standard_error}
            haar = (2**layer.wires - 2) / (2**layer.wires + 1)
            rows.append(row | {"weights": weights} | values | {"haar": haar})
    return pd.DataFrame(rows)


def fisher(trained: Trained) -> pd.DataFrame:
    """One row for each weight of each circuit: the spectrum of the Fisher information of the measured bit strings.

    Columns head, circuit, index, eigenvalue (at the trained weights, largest first), and for the circuit: parameters,
    rank, effective_dimension (over random weights), local_effective_dimension (at the trained ones). The number of
    samples in the effective dimension is the number of training pixels.
    """
    pixels = max(2, len(trained.ray_table().training))
    parts = []
    for row, layer, x in _circuits(trained):
        inputs = x[:FISHER_INPUTS]
        own = diagnostics.fisher(layer, inputs)
        points = diagnostics.random_weights(layer, FISHER_POINTS)
        others = [diagnostics.fisher(layer, inputs, point) for point in points]
        eigenvalues = torch.linalg.eigvalsh(own).flip(0).clamp(min=0)
        summary = {
            "parameters": len(own),
            "rank": int((eigenvalues > 1e-9 * eigenvalues[0]).sum()),
            "effective_dimension": diagnostics.effective_dimension(others, pixels),
            "local_effective_dimension": diagnostics.effective_dimension([own], pixels),
        }
        parts.append(_spectrum(row, eigenvalues, summary))
    return pd.concat(parts, ignore_index=True)


def kernel(trained: Trained) -> pd.DataFrame:
    """One row for each eigenvalue of the tangent kernel of each circuit, and of each head that has circuits.

    Columns head, circuit (-1: the whole head, in all its parameters), index, eigenvalue (of the kernel divided by the
    number of samples; largest first), and effective_rank = (sum of eigenvalues)^2 / sum of their squares.
    """
    modules = [(row, layer, x) for row, layer, x in _circuits(trained)]
    inputs = _inputs(trained, trained.heads)
    names = dict.fromkeys(row["head"] for row, _, _ in modules)
    heads = [({"head": name, "circuit": -1}, trained.heads[name], inputs[name]) for name in names]
    parts = []
    for row, module, x in [*heads, *modules]:
        matrix = diagnostics.tangent_kernel(module, x[:KERNEL_INPUTS].to(next(module.parameters())))
        eigenvalues = torch.linalg.eigvalsh(matrix).flip(0).clamp(min=0) / len(matrix)
        rank = float(eigenvalues.sum().square() / eigenvalues.square().sum())
        parts.append(_spectrum(row, eigenvalues, {"effective_rank": rank}))
    return pd.concat(parts, ignore_index=True)


def surrogate(trained: Trained) -> pd.DataFrame:
    """One row for each circuit and number of waves. Columns head, circuit, waves, covered, error, see `Surrogate`.

    Fitted to and tested on the angles that the run's samples give.
    """
    rows = []
    for row, layer, x in ((row, layer, x[:SAMPLES]) for row, layer, x in _circuits(trained)):
        fitted, tested = x.split([len(x) - len(x) // 3, len(x) // 3])
        for waves in WAVES:
            if 2 * waves > len(fitted):  # more coefficients than samples
                break
            found = diagnostics.surrogate(layer, fitted, tested, waves)
            rows.append(row | vars(found))
            if found.covered:
                break
    return pd.DataFrame(rows)


def _spectrum(row: dict[str, Any], eigenvalues: Tensor, summary: dict[str, Any]) -> pd.DataFrame:
    values = eigenvalues.cpu().numpy()
    return pd.DataFrame({"index": range(len(values)), "eigenvalue": values}).assign(**row, **summary)[
        [*row, "index", "eigenvalue", *summary]
    ]


def _circuits(trained: Trained) -> Iterator[tuple[dict[str, Any], QuantumLayer, Tensor]]:
    """Head and number of each circuit, the circuit, and its inputs for `RAYS` training rays, in random order.

    Raises:
        ValueError: the run has no circuit.
    """
    layers = {
        (name, number): layer
        for name, circuits in trained.circuits().items()
        for number, layer in enumerate(circuits.values())
    }
    inputs = _inputs(trained, layers)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        for (name, number), layer in layers.items():
            yield {"head": name, "circuit": number}, layer, inputs[name, number]


def _inputs(trained: Trained, modules: Mapping[Any, nn.Module]) -> dict[Any, Tensor]:
    """The inputs (N, in) of each module while `RAYS` training rays are rendered, in one random order for all."""
    seen = trained.watched(trained.model, modules, lambda x, _: x.reshape(-1, x.shape[-1]).clone(), RAYS, trained.step)
    generator = torch.Generator().manual_seed(0)
    return {
        key: all_of[torch.randperm(len(all_of), generator=generator).to(all_of.device)]
        for key, all_of in ((key, torch.cat(parts)) for key, parts in seen.items())
    }
