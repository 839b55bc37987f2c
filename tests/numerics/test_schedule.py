"""The optimiser and the schedules at the first step, at the last, and across the corners between."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from qnerf.building.acting import settings_of
from qnerf.building.model import build_model, ray_table
from qnerf.config.settings import Train
from qnerf.geometry.contraction import CONTRACTIONS
from qnerf.quantum import QuantumLayer
from qnerf.rendering.samplers import SAMPLERS
from qnerf.timing import Stopwatch
from qnerf.training.trainer import Trainer, learning_rate
from tests.helpers.scenes import build_scene

NETWORKS = {"samples": [4], "final": 2, "levels": 1, "max_resolutions": [16], "log2_table_size": 4}


@pytest.fixture
def train(tiny: Callable[..., dict[str, Any]]) -> Train:
    return settings_of(tiny("train=paper", "train.steps=30000")).train


def test_the_learning_rate_at_step_0_and_at_the_last(train: Train) -> None:
    assert learning_rate(0, train) == train.lr
    assert learning_rate(train.steps, train) == pytest.approx(train.lr_final, rel=1e-15)
    last = learning_rate(train.steps - 1, train)
    assert train.lr_final < last < train.lr_final * (train.lr / train.lr_final) ** (1.01 / train.steps)
    rates = [learning_rate(step, train) for step in range(train.steps + 1)]
    assert rates == sorted(rates, reverse=True)


@given(steps=st.integers(1, 10_000), slope=st.floats(1, 1e6), step=st.integers(0, 20_000))
def test_annealing_rises_from_0_to_1(steps: int, slope: float, step: int) -> None:
    sampler = SAMPLERS.build("proposal", CONTRACTIONS.build("linf"), anneal_steps=steps, anneal_slope=slope, **NETWORKS)
    assert sampler.anneal(0) == 0
    assert sampler.anneal(steps) == 1
    assert 0 <= sampler.anneal(step) <= sampler.anneal(step + 1) <= 1


@given(every=st.integers(1, 12), warmup=st.integers(0, 60))
def test_the_networks_learn_at_step_0_and_at_least_every_so_many(every: int, warmup: int) -> None:
    sampler = SAMPLERS.build(
        "proposal", CONTRACTIONS.build("linf"), update_every=every, update_warmup=warmup, **NETWORKS
    )
    steps = [step for step in range(200) if sampler.learns(step)]
    assert steps[:10] == list(range(10))
    gaps = [b - a for a, b in pairwise(steps)]
    assert max(gaps) <= every
    assert all(gap == every for step, gap in zip(steps, gaps, strict=False) if step > max(warmup, 10))


def test_the_longest_intervals_and_warm_ups_cost_nothing() -> None:
    contraction = CONTRACTIONS.build("linf")
    slow = SAMPLERS.build("proposal", contraction, update_every=10**9, update_warmup=20, **NETWORKS)
    assert [step for step in (0, 10, 11, 10**9 + 10) if slow.learns(step)] == [0, 10, 10**9 + 10]
    always = SAMPLERS.build("proposal", contraction, update_every=1, update_warmup=10**6, **NETWORKS)
    assert all(always.learns(step) for step in range(0, 2 * 10**6, 97))


@pytest.mark.parametrize("magnitude", [0.0, 1e-38, 1e-30, 1e-20, 1e-10, 1.0, 1e10, 1e18, 1e30])
def test_the_first_step_of_the_optimiser(magnitude: float) -> None:
    """Never beyond the learning rate, whatever the gradient; from 1e-12 to 1e18 in float32 it is the learning rate.

    Below, eps = 1e-15 and then underflow make it smaller; above, the square overflows and the parameter stays.
    """
    parameter = torch.nn.Parameter(torch.zeros(4))
    optimiser = torch.optim.Adam([parameter], lr=1e-2, eps=1e-15, fused=True)
    parameter.grad = torch.tensor([1.0, -1.0, 0.5, 0.0]) * magnitude
    optimiser.step()
    step = parameter.detach().abs()
    assert bool(step.isfinite().all())
    assert bool((step <= 1e-2 * (1 + 1e-6)).all())
    assert float(step[3]) == 0
    if 1e-12 <= magnitude <= 1e18:
        torch.testing.assert_close(step[:3], torch.full((3,), 1e-2), rtol=2e-3, atol=0)


CORNERS = {
    "before the first step": 0,
    "the networks' last step of learning always": 9,
    "their first step without": 10,
    "the end of their warm-up": 13,
    "the last step of annealing": 15,
    "the first step after annealing": 16,
    "the last step": 19,
}


def trainer(config: dict[str, Any]) -> Trainer:
    settings = settings_of(config)
    scene = build_scene(settings)
    model = build_model(settings, scene)
    return Trainer(model, ray_table(settings, scene), settings, Stopwatch(settings.torch_device, model, QuantumLayer))


@pytest.fixture
def corners(tiny: Callable[..., dict[str, Any]]) -> dict[str, Any]:
    """20 steps with every schedule's corner inside."""
    return tiny(
        "field=classical", "cameras=so3xr3", "train.steps=20",
        "sampler.anneal_steps=16", "sampler.update_every=3", "sampler.update_warmup=13",
    )  # fmt: skip


def test_resumed_exactly_at_a_schedule_corner(corners: dict[str, Any]) -> None:
    whole, states = trainer(corners), {}
    while whole.step < 20:
        if whole.step in CORNERS.values():
            states[whole.step] = _copy(whole.state())
        whole.take_step(measure=False)
    for name, step in CORNERS.items():
        resumed = trainer(corners)
        torch.rand(3)  # whatever the process does in between
        resumed.load(states[step])
        while resumed.step < 20:
            resumed.take_step(measure=False)
        for (key, a), b in zip(whole.model.state_dict().items(), resumed.model.state_dict().values(), strict=True):
            assert torch.equal(a, b), f"{name}: {key}"


def _copy(state: Any) -> Any:
    """A checkpoint shares its tensors with the model until it is written."""
    if isinstance(state, torch.Tensor):
        return state.clone()
    if isinstance(state, dict):
        return {key: _copy(value) for key, value in state.items()}
    return [_copy(value) for value in state] if isinstance(state, list) else state
