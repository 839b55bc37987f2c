"""What is not a component: budgets, bounds, device. Components carry their own options (see registry.py)."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import torch

from qnerf.checks import at_least, between, one_of, positive
from qnerf.registry import check_options

BACKGROUNDS = ("last_sample", "white", "black", "random")


@dataclass(frozen=True, kw_only=True)
class Train:
    """Budget and schedule of the training."""

    name: str
    steps: int
    rays: int  # a step
    lr: float
    lr_final: float  # reached at the last step by exponential decay
    eps: float  # of Adam
    interlevel: float  # weight of the interlevel loss
    distortion: float  # weight of the distortion loss
    eval_every: int  # steps; 0: only at the end
    eval_views: int  # views of the evaluations on the way; 0: all
    log_every: int  # steps
    checkpoint_every: float  # seconds
    chunk: int  # rays rendered at once in evaluation

    def __post_init__(self) -> None:
        for name in ("steps", "rays", "log_every", "chunk"):
            at_least(f"train.{name}", getattr(self, name), 1)
        for name in ("interlevel", "distortion", "eval_every", "eval_views", "checkpoint_every"):
            at_least(f"train.{name}", getattr(self, name), 0)
        for name in ("lr", "lr_final", "eps"):
            positive(f"train.{name}", getattr(self, name))


@dataclass(frozen=True, kw_only=True)
class Render:
    """Bounds of the rays and what lies behind them."""

    near: float  # world units
    far: float
    background: str

    def __post_init__(self) -> None:
        one_of("render.background", self.background, BACKGROUNDS)
        at_least("render.near", self.near, 0)
        positive("render.far", self.far)
        if not self.near < self.far:
            raise ValueError(f"render.near must be below render.far, got {self.near} and {self.far}")


@dataclass(frozen=True, kw_only=True)
class Visibility:
    """Where density may be: cells of contracted space seen by at least `cameras` training cameras."""

    cameras: int  # 0: everywhere
    resolution: int  # cells an axis

    def __post_init__(self) -> None:
        at_least("visibility.cameras", self.cameras, 0)
        between("visibility.resolution", self.resolution, 2, 512)


@dataclass(frozen=True, kw_only=True)
class Run:
    """How this invocation behaves; no part of a run's identity."""

    force: bool
    progress: bool
    debug: bool


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The whole configuration: checked scalars, and one plain node for each component."""

    experiment: str | None
    seed: int
    device: str
    threads: int | None
    store: str
    numerics: str
    geo_features: int
    appearance: int
    run: Run
    train: Train
    render: Render
    visibility: Visibility
    contraction: dict
    density: dict
    color: dict
    qiren: dict
    qfgn: dict
    hash: dict
    proposal: dict
    encoder: dict
    scene: dict
    sampler: dict
    gate: dict
    cameras: dict

    def __post_init__(self) -> None:
        between("seed", self.seed, 0, 2**63 - 2)
        one_of("device", self.device, ("auto", "cpu", "cuda"))
        one_of("numerics", self.numerics, ("float32", "float64"))
        at_least("geo_features", self.geo_features, 0)
        at_least("appearance", self.appearance, 0)
        if self.threads is not None:
            at_least("threads", self.threads, 1)
        if self.device == "cuda" and not torch.cuda.is_available():
            raise ValueError("device=cuda: PyTorch sees no CUDA device here; use device=cpu or device=auto")

    @property
    def torch_device(self) -> torch.device:
        if self.device == "auto":
            return torch.device("cuda" if torch.cuda.is_available() else "cpu")
        return torch.device(self.device)

    @property
    def dtype(self) -> torch.dtype:
        return torch.float64 if self.numerics == "float64" else torch.float32


T = TypeVar("T")


def _build(group: str, component: type[T], node: Any) -> T:
    if not isinstance(node, Mapping):
        raise ValueError(f"{group} must be a group of keys, got {node!r}")
    names = {field.name for field in fields(component)}  # type: ignore[arg-type]
    missing = sorted(names - set(node))
    if missing:
        raise ValueError(f"{group}: missing {', '.join(missing)}")
    check_options(group, component, node)
    return component(**node)


def settings_from(config: Mapping[str, Any]) -> Settings:
    """Checks the resolved configuration; ValueError names the key, the value and what was expected."""
    nodes = dict(config)
    for name, section in (("run", Run), ("train", Train), ("render", Render), ("visibility", Visibility)):
        nodes[name] = _build(name, section, nodes.get(name))
    return _build("config", Settings, nodes)
