"""Our functions against the stored results of nerfstudio 1.1.5 for the same inputs.

The stored numbers are those of nerfstudio 1.1.5 in float32. `benchmarks/peers/nerfstudio_functions.py` of commit
5dd4eea wrote them. Keys of the file: `in/...` are inputs, `out/...` are results.
"""

from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import torch

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

DIFFERENT = {
    # nerfstudio computes the position in a cell in float32, we in float64
    "hash encoding": 1e-5,
    "hash encoding, gradient of points": 1e-5,
    "hash encoding, gradient of table": 1e-5,
    # 1 / (2 - 2 s) in float32 loses digits near s = 1; we compute 1 - s first
    "piecewise edges": 1e-4,
    "piecewise edges, jittered": 1e-4,
    "PDF edges": 2e-6,
    # nerfstudio subtracts cumulative sums in float32
    "PDF edges in s": 1e-6,
    "PDF edges in s, jittered": 1e-6,
    "interlevel, gradient": 3e-4,
    # a float32 power just below a whole number is rounded down
    "resolutions, C1": 1,
    "resolutions, C5": 1,
}
"""Result -> its own bound, beyond `BOUND`."""


def read(path=STORED):
    """The inputs and nerfstudio's results."""
    with np.load(path) as stored:
        arrays = {name: torch.from_numpy(stored[name]) for name in stored.files}
    sides = []
    for side in ("in/", "out/"):
        tensors = {name.removeprefix(side): tensor for name, tensor in arrays.items() if name.startswith(side)}
        sides.append({name: t.float() if t.is_floating_point() else t.long() for name, t in tensors.items()})
    return sides[0], sides[1]


def ours(given, theirs):
    """Our results, by the names of nerfstudio's. A function that takes another one's result takes nerfstudio's."""
    return {**_space(given), **_encodings(given), **_rays(given, theirs), **_schedules(), **_step(given)}


def fill(parameters, weights):
    """Sets the parameters, one after the other, to the numbers of `weights`; matrices are divided by sqrt(fan-in)."""
    with torch.no_grad():
        for parameter, values in zip(parameters, weights.split([p.numel() for p in parameters]), strict=True):
            linear = parameter.ndim == 2 and parameter.shape[1] > 2
            parameter.copy_(values.view(parameter.shape) / (parameter.shape[1] ** 0.5 if linear else 1))


def _space(given):
    raw = given["raw"].clone().requires_grad_()
    density = trunc_exp(raw)
    (gradient,) = torch.autograd.grad(density.sum(), raw)
    contracted = CONTRACTIONS.build("linf")(given["points"])
    return {"contraction": contracted, "trunc_exp": density.detach(), "trunc_exp gradient": gradient}


def _encodings(given):
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


def _rays(given, theirs):
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


def _schedules():
    schedule = Schedule(rates=None, lr=1e-2, lr_final=1e-4, steps=STEPS, eps=1e-15)
    # nerfstudio counts 5 where its longest interval has 6 steps.
    sampler = ProposalSampler(CONTRACTIONS.build("linf"), log2_table_size=4, update_every=6, update_warmup=5000)
    return {
        "learning rate": torch.tensor([learning_rate(step, schedule) for step in range(0, STEPS, 250)]),
        "annealing": torch.tensor([sampler.anneal(step) for step in range(0, 2000, 50)]),
        "steps of the proposal networks": torch.tensor([step for step in range(UPDATES) if sampler.learns(step)]),
    }


def _model(dtype):
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


def _step(given):
    """Loss terms and gradients of a training step with nerfstudio's weights, rays and jitter."""
    origins = given["origins"]
    model = _model(origins.dtype)
    parts = model.parts
    groups = [
        [*parts["encoder"], *parts["density"]],
        parts["color"],
        *(list(network.parameters()) for network in model.sampler.networks),
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


@pytest.fixture(scope="module")
def results():
    """nerfstudio's, ours, and ours in float64 for the same float32 inputs."""
    given, theirs = read()
    sides = ({name: t.double() if t.is_floating_point() else t for name, t in side.items()} for side in (given, theirs))
    return theirs, ours(given, theirs), ours(*sides)


def off(one, other, theirs):
    """The largest difference, relative to nerfstudio's largest value; of whole numbers, as it is."""
    scale = float(theirs.abs().max()) if theirs.is_floating_point() else 1.0
    return float((one - other).abs().max()) / scale


def test_functions_agree_with_nerfstudio_within_their_bounds(results):
    theirs, found, _ = results
    assert len(theirs) == 37
    for name, stored in theirs.items():
        usual = STEP_BOUND if name.startswith("a step, gradient") else BOUND if stored.is_floating_point() else 0.0
        assert off(found[name], stored, stored) <= DIFFERENT.get(name, usual), name


def test_functions_that_differ_from_nerfstudio_are_nearer_to_float64(results):
    theirs, found, exact = results
    for name in DIFFERENT:
        stored = theirs[name]
        assert off(found[name], stored, stored) > BOUND, name
        assert off(exact[name], found[name], stored) < off(exact[name], stored, stored), name
