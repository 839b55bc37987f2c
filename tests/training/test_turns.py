"""Trainings that take turns find what belongs to the process as they left it, and one does not end the others."""

import contextlib
import weakref
from collections.abc import Callable, Generator, Iterator
from typing import Any

import pytest
import torch

from qnerf.kernels import dispatch
from qnerf.training.turns import Turns

CPU = torch.device("cpu")
Training = Callable[[dict[str, str]], Generator[bool, None, Any]]


def drawing(seed: int, steps: int) -> Training:
    """Draws a random number a step from PyTorch's default stream, and reports a loop."""

    def training(aside: dict[str, str]) -> Generator[bool, None, Any]:
        torch.manual_seed(seed)
        drawn = []
        for _ in range(steps):
            drawn.append(float(torch.rand(())))
            yield True
        dispatch.step_aside("hash grid", f"seed {seed}")
        return drawn, dict(aside)

    return training


def ended(*trainings: Training) -> list[Any]:
    with contextlib.closing(Turns(trainings, CPU)) as turns:
        while turns.round():
            pass
    return turns.results()


def test_each_draws_and_reports_what_it_would_alone() -> None:
    alone = [ended(drawing(seed, steps))[0] for seed, steps in ((0, 3), (1, 5))]
    assert ended(drawing(0, 3), drawing(1, 5)) == alone
    assert alone[1][1] == {"hash grid": "seed 1"}


def test_an_error_ends_its_own_training_alone() -> None:
    def failing(aside: dict[str, str]) -> Generator[bool, None, Any]:
        yield True
        raise ValueError("of one")

    error, (drawn, _) = ended(failing, drawing(1, 5))
    assert str(error) == "of one"
    assert len(drawn) == 5


def test_a_training_that_fails_leaves_its_memory_to_the_others() -> None:
    class Model:
        pass

    kept = []

    def failing(aside: dict[str, str]) -> Generator[bool, None, Any]:
        model = Model()
        kept.append(weakref.ref(model))
        yield True
        raise ValueError(f"of {type(model).__name__}")

    def training(aside: dict[str, str]) -> Generator[bool, None, Any]:
        yield True
        yield True
        return kept[0]() is None

    assert ended(failing, training)[1]


def test_an_interruption_closes_all() -> None:
    closed = []

    def training(name: str, stops: bool, aside: dict[str, str]) -> Generator[bool, None, Any]:
        try:
            yield True
            if stops:
                raise KeyboardInterrupt
            yield True
        finally:
            closed.append(name)

    with pytest.raises(KeyboardInterrupt):
        ended(lambda aside: training("one", False, aside), lambda aside: training("two", True, aside))
    assert sorted(closed) == ["one", "two"]


def test_on_a_card_the_others_wait_only_for_steps_that_were_not_replayed(monkeypatch: Any) -> None:
    waits: list[tuple[int, int]] = []
    inside: list[int] = []

    class Stream:
        count = 0

        def __init__(self, device: torch.device) -> None:
            self.number, Stream.count = Stream.count, Stream.count + 1

        def wait_stream(self, other: Any) -> None:
            waits.append((self.number, other.number))

    @contextlib.contextmanager
    def on(stream: Any) -> Iterator[None]:
        inside.append(stream.number)
        yield

    def training(aside: dict[str, str]) -> Generator[bool, None, Any]:
        yield False
        yield True

    monkeypatch.setattr(torch.cuda, "Stream", Stream)
    monkeypatch.setattr(torch.cuda, "stream", on)
    turns = Turns([training, training], torch.device("cuda"))
    turns.round()
    assert (inside, set(waits) - {(0, 0), (1, 1)}) == ([0, 1], {(1, 0), (0, 1)})
    waits.clear()
    turns.round()
    assert not waits
