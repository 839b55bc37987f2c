"""The optimiser and the schedules at the first step, at the last, and across the corners between."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from qnerf.building.acting import settings_of
from qnerf.config.settings import Train
from qnerf.geometry.contraction import CONTRACTIONS
from qnerf.rendering.samplers import SAMPLERS
from qnerf.training.trainer import learning_rate

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
