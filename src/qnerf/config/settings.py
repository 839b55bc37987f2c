"""Options that belong to no component: budgets, bounds, device. Components declare their own (see registry.py)."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, TypeVar

import torch

from qnerf.config.checks import at_least, between, one_of, positive
from qnerf.config.registry import check_options

BACKGROUNDS = ("last_sample", "white", "black", "random")
MODEL_PARTS = ("encoder", "density", "color", "sampler", "cameras", "appearance")


@dataclass(frozen=True, kw_only=True)
class Train:
    """Budget and schedule of the training."""

    name: str
    steps: int
    rays: int  # per step
    lr: float
    lr_final: float  # reached at the last step by exponential decay
    rates: dict  # part of the model -> factor on the learning rate
    eps: float  # of Adam
    interlevel: float  # weight of the interlevel loss
    distortion: float  # weight of the distortion loss
    eval_every: int  # steps; 0: only at the end
    eval_views: int  # views evaluated during training; 0: all
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
        if sorted(self.rates) != sorted(MODEL_PARTS) or not all(
            type(rate) in (int, float) for rate in self.rates.values()
        ):
            raise ValueError(f"train.rates must give a number for each of {', '.join(MODEL_PARTS)}, got {self.rates}")
        for part, rate in self.rates.items():
            at_least(f"train.rates.{part}", rate, 0)


@dataclass(frozen=True, kw_only=True)
class Render:
    """Bounds of the rays, and the background behind them."""

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
class PoseNoise:
    """Noise added to the training poses."""

    rotation: float  # standard deviation of each component of a rotation vector, radians
    translation: float  # of each coordinate, world units
    seed: int

    def __post_init__(self) -> None:
        at_least("pose_noise.rotation", self.rotation, 0)
        at_least("pose_noise.translation", self.translation, 0)
        between("pose_noise.seed", self.seed, 0, 2**63 - 1)


@dataclass(frozen=True, kw_only=True)
class Visibility:
    """Where density may be: cells of contracted space seen by at least `cameras` training cameras."""

    cameras: int  # 0: everywhere
    alpha: bool  # also close cells where a training view is transparent
    resolution: int  # cells per axis

    def __post_init__(self) -> None:
        at_least("visibility.cameras", self.cameras, 0)
        between("visibility.resolution", self.resolution, 2, 512)


@dataclass(frozen=True, kw_only=True)
class Occupancy:
    """Closes cells that turn out to be empty during training."""

    every: int  # steps between updates; 0: never
    after: int  # steps before the first update
    min_opacity: float  # below which a cell counts as empty

    def __post_init__(self) -> None:
        at_least("occupancy.every", self.every, 0)
        at_least("occupancy.after", self.after, 0)
        if not 0 < self.min_opacity < 1:
            raise ValueError(f"occupancy.min_opacity must be above 0 and below 1, got {self.min_opacity}")


@dataclass(frozen=True, kw_only=True)
class Stop:
    """Early stopping, judged by training rays that are held out for validation."""

    every: int  # steps between checks; 0: never
    patience: int  # checks without a gain
    min_gain_db: float  # dB that count as a gain
    share: float  # of the training rays, held out for validation
    rays: int  # held-out rays rendered per check

    def __post_init__(self) -> None:
        at_least("stop.every", self.every, 0)
        at_least("stop.patience", self.patience, 1)
        at_least("stop.min_gain_db", self.min_gain_db, 0)
        at_least("stop.rays", self.rays, 1)
        if not 0 < self.share <= 0.5:
            raise ValueError(f"stop.share must be above 0 and at most 0.5, got {self.share}")


@dataclass(frozen=True, kw_only=True)
class Numerics:
    """How numbers are computed."""

    dtype: str  # of model and training
    finite_checks: bool  # stop at the first value that is not finite

    def __post_init__(self) -> None:
        one_of("numerics.dtype", self.dtype, ("float32", "float64"))


@dataclass(frozen=True, kw_only=True)
class Run:
    """How this command behaves; not part of a run's id."""

    force: bool
    progress: bool
    debug: bool


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The whole configuration: checked scalars, and one mapping per component."""

    plugins: list[str]
    experiment: str | None
    seed: int
    device: str
    threads: int | None
    store: str
    geo_features: int
    appearance: int
    run: Run
    numerics: Numerics
    train: Train
    render: Render
    pose_noise: PoseNoise
    visibility: Visibility
    occupancy: Occupancy
    stop: Stop
    needs: dict
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
    shading: dict
    cameras: dict

    def __post_init__(self) -> None:
        between("seed", self.seed, 0, 2**63 - 2)
        one_of("device", self.device, ("auto", "cpu", "cuda"))
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
        return torch.float64 if self.numerics.dtype == "float64" else torch.float32


T = TypeVar("T")


def _build(group: str, component: type[T], node: Any) -> T:
    if not isinstance(node, Mapping):
        raise ValueError(f"{group} must be a group of keys, got {node!r}")
    names = {field.name for field in fields(component)}  # type: ignore[arg-type]
    missing = sorted(names - set(node))
    if missing:
        raise ValueError(f"{group}: missing {', '.join(missing)}")
    check_options("" if component is Settings else f"{group}.", component, node)
    return component(**node)


def settings_from(config: Mapping[str, Any]) -> Settings:
    """Checks the resolved configuration; ValueError names the key, the value and what was expected."""
    nodes = dict(config)
    for field in fields(Settings):
        if isinstance(field.type, type) and is_dataclass(field.type):
            nodes[field.name] = _build(field.name, field.type, nodes.get(field.name))
    return _build("config", Settings, nodes)
