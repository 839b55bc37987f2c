"""The learning rate of each step. How it falls is a registered function."""

import math
from typing import Any

from torch import nn

from qnerf.config.registry import Registry
from qnerf.config.settings import Schedule

SCHEDULES: "Registry[float]" = Registry("train.schedule")
"""Functions of the rate before the fall, the rate after it, and how much of it has passed, from 0 to 1: the rate."""


def paced(model: nn.Module) -> list[Any]:
    """The parts that read how much of the training is done: their `progress`, from 0 to 1."""
    return [part for part in model.modules() if hasattr(type(part), "progress")]


def falls_from(train: Schedule) -> int:
    """The step from which the rate falls, in the last `cooldown` of all steps."""
    return round((1 - train.cooldown) * train.steps)


def learning_rate(step: int, train: Schedule) -> float:
    """It rises in the first `warmup` of all steps, stays at `lr`, and falls to `lr_final` (arXiv:2405.18392).

    >>> train = Schedule(rates=None, steps=100, lr=1.0, lr_final=0.0, eps=1e-15, schedule="linear", cooldown=0.5)
    >>> [learning_rate(step, train) for step in (0, 50, 75, 100)]
    [1.0, 1.0, 0.5, 0.0]
    """
    start = falls_from(train)
    fallen = max(step - start, 0) / max(train.steps - start, 1)
    risen = (step + 1) / max(train.warmup * train.steps, 1)
    return SCHEDULES.get(train.schedule)(train.lr, train.lr_final, fallen) * min(risen, 1.0)


@SCHEDULES.register("exponential")
def exponential(first: float, last: float, fallen: float) -> float:
    """first (last / first)^fallen; ValueError unless last is above 0."""
    if last <= 0:
        raise ValueError("train.lr_final=0 needs train.schedule=linear or cosine; an exponential never reaches 0")
    return first * (last / first) ** fallen


@SCHEDULES.register("linear")
def linear(first: float, last: float, fallen: float) -> float:
    """A straight line."""
    return first + (last - first) * fallen


@SCHEDULES.register("cosine")
def cosine(first: float, last: float, fallen: float) -> float:
    """Half a period of a cosine (Eq. 5, arXiv:1608.03983, without restarts)."""
    return last + (first - last) * (1 + math.cos(math.pi * fallen)) / 2
