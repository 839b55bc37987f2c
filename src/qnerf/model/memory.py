"""How much memory a model and its training will need at least, before any of it is asked for."""

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple, TypeVar

import torch
from torch import nn

from qnerf.config import memory
from qnerf.config.settings import Settings
from qnerf.model.field import Field
from qnerf.quantum import QuantumLayer
from qnerf.rendering.samplers import Sampler

COPIES = 4  # of each parameter: value, gradient, Adam's two moments
PER_SAMPLE = 6  # numbers per interval on a ray: its edges in two coordinates, its middle point, its weight

T = TypeVar("T")


class Need(NamedTuple):
    """Something that takes memory."""

    what: str
    size: float  # bytes
    options: str  # that make it smaller


def planned(build: Callable[[], T]) -> T | None:
    """What `build` returns, with tensors that have shapes but no memory; None if it has a component that needs values.

    >>> planned(lambda: nn.Linear(10**9, 10**9)).weight.shape
    torch.Size([1000000000, 1000000000])
    """
    try:
        with torch.device("meta"):
            return build()
    except (RuntimeError, NotImplementedError, TypeError):
        return None


def require_memory(settings: Settings, field: Field, sampler: Sampler, pixels: int) -> None:
    """ValueError, which names what takes most, if the model and a step need more memory than there is.

    The estimate is a lower bound. On a GPU only the parameters count, which are made on the CPU first.

    Args:
        field, sampler: as built by `planned`.
        pixels: of a view, which bound the rays rendered at once in evaluation.
    """
    needs = sorted(needed(settings, field, sampler, pixels), key=lambda need: need.size, reverse=True)
    largest = needs[0]
    total = sum(need.size for need in needs)
    memory.require(f"training (mostly {largest.what})", total, hint=f"reduce {largest.options}")


def needed(settings: Settings, field: Field, sampler: Sampler, pixels: int) -> Iterator[Need]:
    """What takes memory, each at least as much as it says."""
    trains_here = settings.torch_device.type == "cpu"
    size = torch.finfo(settings.dtype).bits // 8
    modules: list[tuple[str, nn.Module | None, str]] = [
        (
            "the encoder",
            field.encoder,
            "hash.log2_table_size" if settings.encoder["name"] == "hash" else "options of encoder",
        ),
        ("the density head", field.density_head, f"density.{settings.density['name']} or geo_features"),
        ("the colour head", field.color_head, f"color.{settings.color['name']} or geo_features"),
        ("the sampler", sampler, "sampler.log2_table_size, sampler.levels or sampler.hidden"),
        ("the appearance embedding", field.appearance, "appearance"),
    ]
    for what, module, options in modules:
        count = sum(parameter.numel() for parameter in module.parameters()) if module is not None else 0
        yield Need(f"{what}'s parameters", count * size * (COPIES if trains_here else 1), options)
    if not trains_here:
        return

    rays, view = settings.train.rays, min(settings.train.chunk, pixels)
    rendered, proposed = sampler.rendered_samples, sampler.proposed_samples
    yield Need(
        "the samples of a step",
        rays * (rendered + proposed) * PER_SAMPLE * size,
        "train.rays or the samples of the sampler",
    )
    yield Need("the samples of a view", view * rendered * PER_SAMPLE * size, "train.chunk or the samples")

    # With a mask, only the last sample of each ray is sure to be evaluated.
    masked = settings.visibility.cameras or settings.visibility.alpha or settings.occupancy.every
    evaluated = rays * (1 if masked else rendered)
    width = field.encoder.out_dim + activations(field.density_head, size)
    yield Need("the density head's activations", evaluated * width * size, "train.rays, the samples or the head")
    geometry = rays * rendered * settings.geo_features
    yield Need("the geometry features of a step", geometry * size, "train.rays, the samples or geo_features")
    colored = evaluated if settings.shading["name"] == "none" else rays
    width = activations(field.color_head, size)
    yield Need("the colour head's activations", colored * width * size, "train.rays, the samples or the head")


def activations(head: nn.Module, size: int) -> int:
    """Numbers of `size` bytes per sample that a head keeps for its backward pass, at least."""
    total = 0
    for module in head.modules():
        if isinstance(module, nn.Linear):
            total += module.out_features
        elif isinstance(module, QuantumLayer):
            total += module.wires  # the measured values
            if module.method == "pennylane":
                total += math.ceil(2**module.wires * 16 / size)  # one complex128 state
    return total
