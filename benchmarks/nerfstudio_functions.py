"""Our functions on the inputs for which nerfstudio's results are stored, and the differences.

The stored numbers are those of nerfstudio 1.1.5 in float32, written by `python -m benchmarks.nerfstudio --functions`.
"""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from benchmarks.peers.nerfstudio_functions import FAR, HASH, NEAR, RAYS, STEPS, TABLES
from qnerf.encoders import level_resolutions
from qnerf.encoders.directions import DIRECTIONS
from qnerf.geometry.contraction import CONTRACTIONS
from qnerf.heads.activations import trunc_exp
from qnerf.kernels.hashgrid import hash_encode
from qnerf.rendering.pdf import sample_edges
from qnerf.rendering.proposal_sampler import ProposalSampler
from qnerf.rendering.render import render, volume_weights
from qnerf.rendering.samplers import even_edges
from qnerf.rendering.spacing import SPACINGS
from qnerf.training.losses import distortion, interlevel
from qnerf.training.trainer import learning_rate
from qnerf.types import Rays, Samples

STORED = Path(__file__).parents[1] / "tests" / "numerics" / "nerfstudio_1.1.5.npz"
BOUND = 5e-7
"""On the largest difference, relative to the largest value: a few roundings of float32."""

_CELL = "nerfstudio computes the position in a cell in float32, we in float64"
_SUMS = "nerfstudio subtracts cumulative sums in float32"
_FAR = "1 / (2 - 2 s) in float32 loses digits near s = 1; we compute 1 - s first"
_FLOOR = "a float32 power just below a whole number is rounded down"
DIFFERENT: dict[str, tuple[float, str]] = {
    "hash encoding": (1e-5, _CELL),
    "hash encoding, gradient of points": (1e-5, _CELL),
    "hash encoding, gradient of table": (1e-5, _CELL),
    "piecewise edges": (1e-4, _FAR),
    "piecewise edges, jittered": (1e-4, _FAR),
    "PDF edges": (2e-6, _FAR),
    "PDF edges in s": (1e-6, _SUMS),
    "PDF edges in s, jittered": (1e-6, _SUMS),
    "interlevel, gradient": (3e-4, _SUMS),
    "resolutions, C1": (1, _FLOOR),
    "resolutions, C5": (1, _FLOOR),
}
"""Result -> its own bound, and why it differs by more than `BOUND`."""


def read(path: Path = STORED) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """The inputs and nerfstudio's results."""
    with np.load(path) as stored:
        arrays = {name: torch.from_numpy(stored[name]) for name in stored.files}
    sides = []
    for side in ("in/", "out/"):
        tensors = {name.removeprefix(side): tensor for name, tensor in arrays.items() if name.startswith(side)}
        sides.append({name: t.float() if t.is_floating_point() else t.long() for name, t in tensors.items()})
    return sides[0], sides[1]


def ours(given: dict[str, Tensor], theirs: dict[str, Tensor]) -> dict[str, Tensor]:
    """Our results, by the names of nerfstudio's. A function that takes another one's result takes nerfstudio's."""
    return {**_space(given), **_encodings(given), **_rays(given, theirs), **_schedules()}


def _space(given: dict[str, Tensor]) -> dict[str, Tensor]:
    raw = given["raw"].clone().requires_grad_()
    density = trunc_exp(raw)
    (gradient,) = torch.autograd.grad(density.sum(), raw)
    contracted = CONTRACTIONS.build("linf")(given["points"])
    return {"contraction": contracted, "trunc_exp": density.detach(), "trunc_exp gradient": gradient}


def _encodings(given: dict[str, Tensor]) -> dict[str, Tensor]:
    table, unit = given["table"].clone().requires_grad_(), given["unit"].clone().requires_grad_()
    cells = torch.tensor(level_resolutions(HASH["levels"], HASH["min_resolution"], HASH["max_resolution"]))
    encoded = hash_encode(unit, table, cells, dense=False)
    to_unit, to_table = torch.autograd.grad(encoded.square().sum(), (unit, table))
    result = {
        "spherical harmonics": DIRECTIONS.build("sh", degree=4, interval="unit")(given["directions"]),
        "hash encoding": encoded.detach(),
        "hash encoding, gradient of points": to_unit,
        "hash encoding, gradient of table": to_table,
    }
    return result | {f"resolutions, {name}": torch.tensor(level_resolutions(*sizes)) for name, sizes in TABLES.items()}


def _rays(given: dict[str, Tensor], theirs: dict[str, Tensor]) -> dict[str, Tensor]:
    near, far = (torch.full((RAYS, 1), bound).to(given["density"]) for bound in (NEAR, FAR))
    directions = given["directions"][:RAYS]
    rays = Rays(torch.zeros_like(directions), directions, torch.zeros(RAYS, dtype=torch.int64), near, far)
    spacing = SPACINGS.build("piecewise", near, far)
    even = even_edges(rays, 24, None)
    first, drawn = Samples(theirs["piecewise edges"], even), Samples(theirs["PDF edges"], theirs["PDF edges in s"])
    outer = theirs["outer weights"].clone().requires_grad_()
    density = given["density"].clone().requires_grad_()
    weights = volume_weights(density, drawn.deltas)
    (weights_gradient,) = torch.autograd.grad(weights.square().sum(), density)
    leaf = theirs["weights"].clone().requires_grad_()
    spread = distortion(drawn, leaf)
    excess = interlevel(drawn, leaf, [(first, outer)])
    rendering, _ = render(leaf.detach(), given["color"], drawn, background="last_sample")
    return {
        "piecewise edges": spacing.to_world(even),
        "piecewise edges, jittered": spacing.to_world(even_edges(rays, 24, given["jitter"])),
        "PDF edges in s": sample_edges(even, outer, 49),
        "PDF edges in s, jittered": sample_edges(even, outer, 49, jitter=given["jitter"]),
        "PDF edges": spacing.to_world(theirs["PDF edges in s"]),
        "outer weights": volume_weights(given["outer density"], first.deltas),
        "weights": weights.detach(),
        "weights, gradient": weights_gradient,
        "color": rendering.color,
        "accumulation": rendering.accumulation,
        "depth": rendering.depth_median,
        "expected depth": rendering.depth,
        "distortion": spread.detach(),
        "distortion, gradient": torch.autograd.grad(spread, leaf)[0],
        "interlevel": excess.detach(),
        "interlevel, gradient": torch.autograd.grad(excess, outer)[0],
    }


def _schedules() -> dict[str, Tensor]:
    schedule: Any = SimpleNamespace(lr=1e-2, lr_final=1e-4, steps=STEPS)
    sampler = ProposalSampler(CONTRACTIONS.build("linf"), log2_table_size=4)
    return {
        "learning rate": torch.tensor([learning_rate(step, schedule) for step in range(0, STEPS, 250)]),
        "annealing": torch.tensor([sampler.anneal(step) for step in range(0, 2000, 50)]),
    }


def differences(path: Path = STORED) -> pd.DataFrame:
    """A row for each result. Differences are the largest ones, relative to nerfstudio's largest value; of resolutions,
    in cells.

    Columns: `function`; `difference` between nerfstudio and ours, its `bound` and `why` it is not `BOUND`; `theirs` and
    `ours`: the differences from our result in float64 for the same float32 inputs.
    """
    given, theirs = read(path)
    computed = ours(given, theirs)
    exact = ours(
        *({name: t.double() if t.is_floating_point() else t for name, t in s.items()} for s in (given, theirs))
    )
    rows = []
    for name, stored in theirs.items():
        cells = name.startswith("resolutions")
        scale = 1.0 if cells else float(stored.abs().max())
        pairs = {"difference": (computed, theirs), "theirs": (exact, theirs), "ours": (exact, computed)}
        errors = {key: float((a[name] - b[name]).abs().max()) / scale for key, (a, b) in pairs.items()}
        bound, why = DIFFERENT.get(name, (0.0 if cells else BOUND, ""))
        rows.append({"function": name, **errors, "bound": bound, "why": why})
    return pd.DataFrame(rows)
