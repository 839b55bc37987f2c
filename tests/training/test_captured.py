"""Steps that were recorded compute what plain ones do, and nothing that changes is frozen; on a fake of CUDA graphs."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

from qnerf.building.scene import prepare
from qnerf.kernels import dispatch
from qnerf.quantum import QuantumLayer
from qnerf.rendering.proposal_sampler import ProposalSampler
from qnerf.timing import Stopwatch
from qnerf.training.losses import mse
from qnerf.training.terms import LOSSES, Step
from qnerf.training.trainer import Loop
from tests.helpers.configs import composed
from tests.helpers.fake_graph import FakeCard, plain_and_fixed
from tests.helpers.trainer import same, trainer

STEPS = 45
COMMON = ("numerics.dtype=float64", "train.steps=60", "train.rays=8")
PROPOSAL = ("sampler.anneal_steps=10", "sampler.update_every=2")


@pytest.fixture(autouse=True)
def like_a_gpu(monkeypatch: Any) -> Iterator[None]:
    with plain_and_fixed(monkeypatch):
        yield


def compared(build: Callable[[], Loop], every: int = 5) -> tuple[Loop, Loop, str]:
    """A training step by step, the same on a card, and what its record says about graphs. Both log the same.

    every: so many steps one is logged.
    """
    plain, captured = build(), build()
    captured.graphs.card = FakeCard()  # type: ignore[assignment]
    logged = []
    with dispatch.report() as aside:
        for loop in (plain, captured):
            torch.manual_seed(0)
            metrics = [loop.take_step(measure=(number + 1) % every == 0) for number in range(STEPS)]
            logged.append([{key: value for key, value in row.items() if "time/" not in key} for row in metrics])
    assert logged[0] == logged[1]
    return plain, captured, aside.get("CUDA graph", "")


def differ(one: Any, other: Any, path: str = "") -> list[str]:
    if isinstance(one, dict):
        return [found for key in one for found in differ(one[key], other[key], f"{path}.{key}")]
    return [] if same(one, other) else [f"{path} {(one - other).abs().max()}"]


def learnt(loop: Loop) -> dict[str, Any]:
    return {key: value for key, value in loop.state().items() if key != "step_seconds"}


@pytest.mark.parametrize(
    "options",
    [
        (*PROPOSAL, "field=classical", "train.error_rays=0.5", "visibility.cameras=1", "render.background=random"),
        (*PROPOSAL, "field=qcolor", "cameras=so3xr3", "train.distortion=0.01", "appearance=2"),
        (*PROPOSAL, "field=qdensity", "visibility.cameras=1", "shading=merge"),
        ("field=classical", "encoder=pe", "sampler=uniform"),
    ],
)
def test_a_recorded_training_is_the_plain_one(tiny: Any, options: tuple[str, ...]) -> None:
    config = tiny(*COMMON, *options)
    plain, captured, reason = compared(lambda: trainer(config))
    assert not reason
    assert len(captured.graphs.recorded) == (1 if "sampler=uniform" in options else 2)
    assert not differ(learnt(plain), learnt(captured))


def test_steps_that_are_all_logged_are_recorded(tiny: Any) -> None:
    config = tiny(*COMMON, *PROPOSAL, "field=classical")
    plain, captured, reason = compared(lambda: trainer(config), every=1)
    assert (reason, len(captured.graphs.recorded)) == ("", 2)
    assert not differ(learnt(plain), learnt(captured))


def test_a_recorded_training_of_a_signal_is_the_plain_one() -> None:
    options = ("scene=tones", "scene.dims=2", "scene.octaves=3", "scene.size=16", "head=qiren", "qiren.qubits=2")
    config = composed(*options, "train.steps=60", "train.points=64", "hash=C7", "device=cpu", "numerics.dtype=float64")

    def build() -> Loop:
        prepared = prepare(config)
        task = prepared.task
        task.build(prepared.settings)
        return task.trainer(Stopwatch(torch.device("cpu"), task.model, QuantumLayer))

    plain, captured, reason = compared(build)
    assert not reason
    assert captured.graphs.recorded
    assert not differ(learnt(plain), learnt(captured))


def test_stages_that_follow_the_progress_keep_the_plain_way(tiny: Any) -> None:
    config = tiny(*COMMON, *PROPOSAL, "color=residual", "qiren.qubits=2")
    plain, captured, reason = compared(lambda: trainer(config))
    assert reason == "the model: it reads the number of the step"
    assert not differ(learnt(plain), learnt(captured))


def late(step: Step) -> Tensor | None:
    return mse(step.rendering.color, 1 - step.target) if step.number >= 35 else None


def read(step: Step) -> Tensor:
    return step.rendering.color.sum() * float(step.target.mean())


def drawn(step: Step) -> Tensor:
    return step.rendering.color.sum() * torch.rand((), dtype=step.target.dtype)


@pytest.mark.parametrize(
    ("term", "reason"),
    [
        (late, "the loss term own: it reads the number of the step"),
        (read, "the loss term own: operation not permitted when stream is capturing"),
        (drawn, "a step: random numbers are drawn on the CPU"),
    ],
)
def test_a_term_that_a_graph_would_freeze_keeps_the_plain_way(
    tiny: Any, monkeypatch: Any, term: Any, reason: str
) -> None:
    monkeypatch.setitem(LOSSES._components, "own", term)
    config = tiny(*COMMON, *PROPOSAL, "field=classical", "train.losses={own: 0.1}")
    plain, captured, found = compared(lambda: trainer(config))
    assert found == reason
    assert not captured.graphs.recorded
    assert not differ(learnt(plain), learnt(captured))


def test_a_frozen_number_shows(tiny: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr(ProposalSampler, "phase", lambda self, step: (self.learns(step),))
    config = tiny(*COMMON, *PROPOSAL, "field=classical", "sampler.anneal_steps=1000")
    with pytest.raises(AssertionError, match="train/loss"):
        compared(lambda: trainer(config))
