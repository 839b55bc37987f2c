"""The terms whose weighted sum the training of a radiance field minimises. One of your own is a registered function."""

from typing import NamedTuple

from torch import Tensor

from qnerf.config.registry import Registry
from qnerf.config.settings import Train
from qnerf.model.model import Model
from qnerf.rendering.samplers import SampledRays
from qnerf.training.losses import distortion, interlevel, mse, sparse_depth
from qnerf.types import Rendering


class Step(NamedTuple):
    """What a step has rendered, and what it should have."""

    rendering: Rendering
    sampled: SampledRays
    target: Tensor  # (R, 3) true colours, on the background that the rendering has
    model: Model
    number: int  # of the step, from 0
    logged: bool  # whether its metrics are
    distances: Tensor | None  # (P,) along the first P rays to their sparse points, world units; None: not drawn


LOSSES: "Registry[Tensor | None]" = Registry("train.losses")
"""Functions of a `Step`: a scalar, or None where the term does not act in this step."""


def weights_of(train: Train) -> dict[str, float]:
    """Name -> weight of the terms that act. `train.losses` adds to the built-in ones, or replaces their weights.

    Raises:
        ValueError: a name that is not registered.
    """
    built_in = {"mse": 1.0, "distortion": train.distortion, "interlevel": train.interlevel, "poses": 1.0}
    weights = {name: weight for name, weight in (built_in | (train.losses or {})).items() if weight}
    for name in weights:
        LOSSES.get(name)
    return weights


@LOSSES.register("mse")
def _colors(step: Step) -> Tensor:
    return mse(step.rendering.color, step.target)


@LOSSES.register("distortion")
def _distortion(step: Step) -> Tensor:
    return distortion(step.sampled.samples, step.rendering.weights)


@LOSSES.register("interlevel")
def _interlevel(step: Step) -> Tensor | None:
    """In steps in which no proposal network learns it has no gradient, and is computed only to be logged."""
    proposals = step.sampled.proposals
    if not proposals or not (step.logged or any(weights.requires_grad for _, weights in proposals)):
        return None
    return interlevel(step.sampled.samples, step.rendering.weights, proposals)


@LOSSES.register("sparse_depth")
def _sparse_depth(step: Step) -> Tensor:
    assert step.distances is not None
    known = slice(len(step.distances))
    return sparse_depth(step.sampled.samples.edges[known], step.rendering.weights[known], step.distances)


@LOSSES.register("poses")
def _poses(step: Step) -> Tensor | None:
    return step.model.cameras.penalty()
