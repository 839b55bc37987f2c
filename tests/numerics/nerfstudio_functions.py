"""Our functions on the inputs for which nerfstudio's results are stored, and the differences.

The stored numbers are those of nerfstudio 1.1.5 in float32. `benchmarks/peers/nerfstudio_functions.py` of commit
5dd4eea wrote them. Keys of the file: `in/...` are inputs, `out/...` are results.
"""

from pathlib import Path
from unittest.mock import patch

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from qnerf.config.settings import Schedule
from qnerf.encoders import level_resolutions
from qnerf.encoders.directions import DIRECTIONS
from qnerf.encoders.hash import HashEncoder
from qnerf.geometry.contraction import CONTRACTIONS
from qnerf.geometry.pose_refinement import CAMERAS
from qnerf.heads import HEADS
from qnerf.heads.activations import sigmoid, trunc_exp
from qnerf.kernels.hashgrid import hash_encode
from qnerf.model.field import Field
from qnerf.model.model import Model
from qnerf.quantum import QuantumLayer
from qnerf.rendering.pdf import sample_edges
from qnerf.rendering.proposal_sampler import ProposalSampler
from qnerf.rendering.render import render, volume_weights
from qnerf.rendering.samplers import even_edges
from qnerf.rendering.shading import SHADINGS
from qnerf.rendering.spacing import SPACINGS
from qnerf.timing import Stopwatch
from qnerf.training.losses import distortion, interlevel, mse
from qnerf.training.schedules import learning_rate
from qnerf.types import Rays, Samples

STORED = Path(__file__).parent / "nerfstudio_1.1.5.npz"
RAYS = 12
NEAR, FAR = 0.05, 1000.0
HASH = {"levels": 5, "min_resolution": 16, "max_resolution": 128, "log2_table_size": 9, "features": 2}
TABLES = {  # levels, coarsest and finest resolution of the paper's hash tables and of the two proposal networks
    "C1": (16, 16, 2048),
    "C3": (12, 16, 2048),
    "C5": (12, 16, 1024),
    "C6": (8, 16, 1024),
    "proposal 1": (5, 16, 128),
    "proposal 2": (5, 16, 256),
}
STEPS = 10_000
MODEL = {"levels": 4, "min_resolution": 16, "max_resolution": 128, "log2_table_size": 7, "features": 2}
"""The field's hash grid of the model that takes a step; those of its proposal networks have as many entries."""
GEOMETRY, SAMPLES, FINAL = 5, (24, 16), 12
FINEST = (128, 256)  # of the proposal networks
UPDATES = 6000  # steps of the schedule of proposal updates
STEP = 99  # in the middle of annealing; the proposal networks learn

BOUND = 5e-7
"""On the largest difference, relative to the largest value: a few roundings of float32."""
STEP_BOUND = 5e-6
"""On gradients of a whole step, which pass through dozens of sums in float32."""

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
    return {**_space(given), **_encodings(given), **_rays(given, theirs), **_schedules(), **_step(given)}


def fill(parameters: list[torch.nn.Parameter], weights: Tensor) -> None:
    """Sets the parameters, one after the other, to the numbers of `weights`; matrices are divided by sqrt(fan-in)."""
    with torch.no_grad():
        for parameter, values in zip(parameters, weights.split([p.numel() for p in parameters]), strict=True):
            linear = parameter.ndim == 2 and parameter.shape[1] > 2
            parameter.copy_(values.view(parameter.shape) / (parameter.shape[1] ** 0.5 if linear else 1))


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
    schedule = Schedule(rates=None, lr=1e-2, lr_final=1e-4, steps=STEPS, eps=1e-15)
    # nerfstudio counts 5 where its longest interval has 6 steps.
    sampler = ProposalSampler(CONTRACTIONS.build("linf"), log2_table_size=4, update_every=6, update_warmup=5000)
    return {
        "learning rate": torch.tensor([learning_rate(step, schedule) for step in range(0, STEPS, 250)]),
        "annealing": torch.tensor([sampler.anneal(step) for step in range(0, 2000, 50)]),
        "steps of the proposal networks": torch.tensor([step for step in range(UPDATES) if sampler.learns(step)]),
    }


def _model(dtype: torch.dtype) -> Model:
    contraction = CONTRACTIONS.build("linf")
    encoder = HashEncoder(3, **MODEL, dense=False)
    directions = DIRECTIONS.build("sh", degree=4, interval="unit")
    heads = (
        HEADS.build("mlp", encoder.out_dim, 1 + GEOMETRY, layers=2, width=64),
        HEADS.build("mlp", directions.out_dim + GEOMETRY, 3, layers=3, width=64),
    )
    field = Field(contraction, encoder, directions, *heads, trunc_exp, sigmoid, 1.0, 2, [0, 1], 0)
    sampler = ProposalSampler(
        contraction,
        samples=list(SAMPLES),
        final=FINAL,
        max_resolutions=list(FINEST),
        log2_table_size=MODEL["log2_table_size"],
        update_every=1,
    )
    return Model(field, sampler, CAMERAS.build("fixed", 2, [0, 1]), SHADINGS.build("none")).to(dtype)


def _step(given: dict[str, Tensor]) -> dict[str, Tensor]:
    """Loss terms and gradients of a training step with nerfstudio's weights, rays and jitter."""
    origins = given["origins"]
    model = _model(origins.dtype)
    parts = model.parts
    groups = [
        [*parts["encoder"], *parts["density"]],
        parts["color"],
        *(list(network.parameters()) for network in model.sampler.networks),  # type: ignore[union-attr]
    ]
    fill([parameter for group in groups for parameter in group], given["weights"])
    bounds = (torch.full((RAYS, 1), bound).to(origins) for bound in (NEAR, FAR))
    rays = Rays(origins, given["directions"][:RAYS], torch.zeros(RAYS, dtype=torch.int64), *bounds)
    watch = Stopwatch(torch.device("cpu"), model, QuantumLayer)
    with patch("qnerf.rendering.proposal_sampler.draw_jitter", lambda *_: list(given["jitters"])):
        rendering, sampled, _ = model(rays, background="last_sample", step=STEP, watch=watch)
    spread = 0.002 * distortion(sampled.samples, rendering.weights)
    excess = interlevel(sampled.samples, rendering.weights, sampled.proposals)
    loss = torch.stack([mse(rendering.color, given["color"][:, 0]), spread, excess])
    loss.sum().backward()
    gradients = {
        f"a step, gradient of {name}": torch.cat([p.grad.flatten() for p in group if p.grad is not None])
        for name, group in zip(("density", "color", "proposal 1", "proposal 2"), groups, strict=True)
    }
    return {"a step, loss": loss.detach(), **gradients}


def differences(path: Path = STORED) -> pd.DataFrame:
    """A row for each result. Differences are the largest ones, relative to nerfstudio's largest value; of whole
    numbers, as they are.

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
        whole = not stored.is_floating_point()
        scale = 1.0 if whole else float(stored.abs().max())
        pairs = {"difference": (computed, theirs), "theirs": (exact, theirs), "ours": (exact, computed)}
        errors = {key: float((a[name] - b[name]).abs().max()) / scale for key, (a, b) in pairs.items()}
        usual = 0.0 if whole else STEP_BOUND if name.startswith("a step, gradient") else BOUND
        bound, why = DIFFERENT.get(name, (usual, ""))
        rows.append({"function": name, **errors, "bound": bound, "why": why})
    return pd.DataFrame(rows)
