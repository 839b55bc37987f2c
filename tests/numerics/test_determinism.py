"""The same seed gives the same bits. One test a promise; where there is none, the docstring says why."""

import io
import json
import os
import subprocess
import sys
from functools import partial
from itertools import product

import pytest
import torch

from qnerf.kernels.grid_mlp import Grid, grid_mlp
from qnerf.kernels.hashgrid import hash_encode
from qnerf.kernels.mlp import layers_of, mlp
from qnerf.quantum import QuantumLayer
from qnerf.rendering.pdf import sample_edges
from qnerf.training.losses import distortion, interlevel
from qnerf.types import Samples
from tests.helpers.configs import ROOT
from tests.helpers.trainer import same, trainer

EVERYTHING = ("field=qboth", "qiren=1L2S", "qiren.qubits=4", "cameras=se3", "appearance=2", "train.distortion=0.01")
CHILD = """
import json, sys
import torch
from tests.numerics.test_determinism import compared, trained
torch.set_num_threads(1)
config = json.load(sys.stdin)
torch.save(compared(trained(config, 3)), config["store"] + ".pt")
"""


def trained(config, steps):
    made = trainer(config)
    for _ in range(steps):
        made.take_step(measure=False)
    return made


def compared(made):
    """All that the next step depends on."""
    return {key: value for key, value in made.state().items() if key not in ("step_seconds", "torch_random")}


@pytest.fixture
def one_thread():
    torch.set_num_threads(1)


@pytest.mark.usefixtures("one_thread")
def test_training_in_a_fresh_process(tiny):
    """With the same number of threads on the same machine: instruction sets and libraries choose the order of sums."""
    config = tiny(*EVERYTHING)
    path = os.pathsep.join([str(ROOT), *filter(None, sys.path)])
    environment = {**os.environ, "PYTHONPATH": path, "PYTHONHASHSEED": "7"}
    child = subprocess.run(
        [sys.executable, "-c", CHILD], input=json.dumps(config), capture_output=True, text=True, env=environment
    )
    assert child.returncode == 0, child.stderr
    theirs = torch.load(config["store"] + ".pt", weights_only=True)
    assert same(theirs, compared(trained(config, 3)))
    assert not same(theirs, compared(trained({**config, "seed": 1}, 3)))


def on_threads(count, compute):
    torch.set_num_threads(count)
    return compute()


def loops():
    """Functions with compiled loops, and batches large enough to be shared among threads."""
    cells, points, table = torch.tensor([16, 60, 250]), torch.rand(5000, 3), torch.rand(3, 2**10, 2)
    layers = torch.randn(16, 6), torch.randn(16), torch.randn(3, 16), torch.randn(3)
    places, inside = torch.rand(5000, 3), torch.rand(5000) < 0.6
    samples, outer = (Samples(s, s) for s in (torch.rand(3000, count).sort(-1).values for count in (49, 97)))
    weights, proposed = torch.rand(3000, 48) / 48, torch.rand(3000, 96) / 96

    def with_layers(table, *parameters):
        return grid_mlp(places, inside, Grid(table, cells, True), layers_of(parameters))

    found = {
        "hash grid": (lambda *leaves: hash_encode(*leaves, cells), (points, table)),
        "hash grid and MLP": (with_layers, (table, *layers)),
        "MLP": (lambda rows, *parameters: mlp(rows, layers_of(parameters)), (torch.rand(5000, 6), *layers)),
        "distortion": (partial(distortion, samples), (weights,)),
        "interlevel": (lambda proposed: interlevel(samples, weights, [(outer, proposed)]), (proposed,)),
        "drawing": (lambda: sample_edges(outer.spacing, proposed, 49), ()),
    }
    for method, dtype in product(("statevector", "lightcone"), (torch.float32, torch.float64)):
        layer = QuantumLayer(6, 1, method=method, backend="compiled").to(dtype)
        x = torch.randn(3001, 6, dtype=dtype)
        found[f"{method} in {dtype}"] = (lambda x, *_, layer=layer: layer(x), (x, *layer.parameters()))
    return found


def test_compiled_loops_on_1_2_and_3_threads():
    """They sum in fixed parts, whoever computes these. What is in plain PyTorch promises nothing."""
    for name, (function, inputs) in loops().items():
        leaves = [tensor.requires_grad_() for tensor in inputs]

        def compute(function=function, leaves=leaves):
            torch.manual_seed(0)
            y = function(*leaves)
            upstream = torch.linspace(-1, 1, y.numel(), dtype=y.dtype).view_as(y)
            return [y, *(torch.autograd.grad(y, leaves, upstream) if leaves else ())]

        one, two, three = (on_threads(count, compute) for count in (1, 2, 3))
        assert all(map(torch.equal, one, two)), name
        assert all(map(torch.equal, one, three)), name


def test_batches_and_samples_on_1_and_2_threads(tiny):
    """What is drawn, and how the networks of the first step place the samples."""
    taken = trainer(tiny("field=qcolor", "train.rays=512"))

    def compute():
        drawn = torch.Generator().manual_seed(3)
        rays, colors = taken.table.batch(taken.table.draw(512, drawn), taken.model.cameras)
        sampled = taken.model.sampler(rays, taken.model.field.density, generator=drawn, step=20)
        return [rays.directions, colors, sampled.samples.edges]

    assert all(torch.equal(a, b) for a, b in zip(on_threads(1, compute), on_threads(2, compute), strict=True))


def test_whole_steps_on_1_and_2_threads_agree_as_long_as_no_gradient_is_rounding_alone(tiny):
    """No promise of bits: PyTorch splits sums over rows (gradients of linear layers, means) among threads, and adds the
    parts in another order. Adam divides by the size of the gradient, so where that is rounding alone (the biases of
    geometry features, which a later normalisation cancels) its steps are of full length in any direction.
    """
    config = tiny("field=classical", "train.rays=512")
    one, two = (on_threads(count, lambda: list(trained(config, 2).model.state_dict().values())) for count in (1, 2))
    for a, b in zip(one, two, strict=True):
        assert (a.double() - b.double()).abs().max() <= 1e-6


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("at", [1, 9, 10, 12], ids=["first", "last early update", "interval grows", "annealed"])
def test_training_through_a_resume(tiny, at):
    """At corners of the schedules too: the last of the first ten steps, in which the proposal networks learn each time,
    the first after it, and the step at which the annealing ends. The optimiser's state goes through a file.
    """
    schedule = ("sampler.anneal_steps=12", "sampler.update_warmup=14", "train.steps=16")
    config = tiny(*EVERYTHING, *schedule)
    through = compared(trained(config, 16))
    file = io.BytesIO()
    torch.save(trained(config, at).state(), file)
    file.seek(0)
    resumed = trainer(config)
    resumed.load(torch.load(file, weights_only=True))
    while resumed.step < 16:
        resumed.take_step(measure=False)
    assert same(compared(resumed), through)
