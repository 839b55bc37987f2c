"""Options that belong to no component: budgets, bounds, device. Components declare their own (see registry.py).

A default here is what a run did before the option existed, or does without it. It decides ids: an option at its default
is not hashed (`building/acting.py`), so an option that is added later leaves all ids as they are.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Annotated, Any, Literal, TypeVar, get_args

import torch
from annotated_types import Interval, Len, MinLen

from qnerf.config import devices
from qnerf.config.bounds import Factor, NonNegativeFactor, NonNegativeInt, PositiveFactor, PositiveInt, Seed

# Float32, in which most runs compute, has no larger or smaller numbers than about 1e38 and 1e-38.
Rate = Annotated[float, Interval(ge=1e-30, le=1e6)]
Beta = Annotated[float, Interval(ge=0, lt=1)]
Length = Annotated[float, Interval(ge=0, le=1e9)]  # world units
Validation = Annotated[float, Interval(gt=0, le=0.5)] | None  # of what trains; None: nothing is held out for validation
Name = Annotated[str, MinLen(1)]
Background = Literal["last_sample", "white", "black", "random"]
BACKGROUNDS: tuple[str, ...] = get_args(Background)
T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class FieldRates:
    """Factors on the learning rate of each part of a radiance field."""

    encoder: NonNegativeFactor = 1.0
    density: NonNegativeFactor = 1.0
    color: NonNegativeFactor = 1.0
    sampler: NonNegativeFactor = 1.0
    cameras: NonNegativeFactor = 1.0
    appearance: NonNegativeFactor = 1.0


@dataclass(frozen=True, kw_only=True)
class SignalRates:
    """Factors on the learning rate of each part of the model of a signal."""

    encoder: NonNegativeFactor = 1.0
    head: NonNegativeFactor = 1.0


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """Budget and schedule of any training."""

    rates: Any
    name: Name = "custom"  # of the recipe
    steps: PositiveInt
    lr: Rate
    lr_final: Annotated[float, Interval(ge=0, le=1e6)]  # after the last step
    eps: Rate  # of Adam
    betas: Annotated[list[Beta], Len(2, 2)] = field(default_factory=lambda: [0.9, 0.999])  # of Adam
    schedule: Name = "exponential"  # shape of the fall from lr to lr_final
    cooldown: Annotated[float, Interval(ge=1e-3, le=1)] = 1.0  # share of the steps, the last ones, in which it falls
    warmup: Annotated[float, Interval(ge=0, le=1)] = 0.0  # share of the steps, the first ones, in which it rises from 0
    eval_every: NonNegativeInt = 0  # steps; 0: only at the end
    log_every: PositiveInt = 10  # steps
    checkpoint_every: Annotated[float, Interval(ge=0, le=1e9)] = 20.0  # seconds


@dataclass(frozen=True, kw_only=True)
class Train(Schedule):
    """Training of a radiance field."""

    rates: FieldRates
    rays: Annotated[int, Interval(ge=1, le=2**24)]  # per step
    error_rays: Annotated[float, Interval(ge=0, lt=1)] = 0.0  # share of the rays drawn where the error is
    interlevel: NonNegativeFactor = 0.0  # weight of the interlevel loss
    distortion: NonNegativeFactor = 0.0  # weight of the distortion loss
    losses: dict[str, NonNegativeFactor] | None = None  # weights of further registered terms
    eval_views: NonNegativeInt = 0  # views evaluated during training; 0: all
    chunk: Annotated[int, Interval(ge=1, le=2**24)] = 2048  # rays rendered at once in evaluation


@dataclass(frozen=True, kw_only=True)
class Fit(Schedule):
    """Training of one head on a signal."""

    rates: SignalRates
    points: Annotated[int, Interval(ge=1, le=2**24)]  # per step; all of them where the signal has no more


@dataclass(frozen=True, kw_only=True)
class Render:
    """Bounds of the rays, and the background behind them."""

    near: Length | None = None  # world units; None: the scene's, or 0.05
    far: Annotated[float, Interval(gt=0, le=1e9)] | None = None  # world units; None: the scene's, or 1000
    background: Background = "last_sample"

    def __post_init__(self) -> None:
        if self.near is not None and self.far is not None and not self.near < self.far:
            raise ValueError(f"render.near must be below render.far, got {self.near} and {self.far}")


@dataclass(frozen=True, kw_only=True)
class PoseNoise:
    """Noise added to the training poses."""

    # Standard deviation of each component of a rotation vector, radians.
    rotation: Annotated[float, Interval(ge=0, le=math.tau)] = 0.0
    translation: Length = 0.0  # standard deviation of each coordinate
    seed: Seed = 0


@dataclass(frozen=True, kw_only=True)
class Visibility:
    """Where density may be: cells of contracted space seen by at least `cameras` training cameras."""

    cameras: NonNegativeInt = 0  # 0: everywhere
    alpha: bool = False  # also close cells where a training view is transparent
    resolution: Annotated[int, Interval(ge=2, le=512)] = 96  # cells per axis


@dataclass(frozen=True, kw_only=True)
class Stop:
    """Early stopping, judged by training rays that are held out for validation."""

    every: NonNegativeInt = 0  # steps between checks; 0: never
    patience: PositiveInt = 5  # checks without a gain
    min_gain_db: Annotated[float, Interval(ge=0, le=1e3)] = 0.05  # dB that count as a gain
    share: Annotated[float, Interval(ge=1e-9, le=0.5)] = 0.02  # of the training rays, held out for validation
    rays: PositiveInt = 2048  # held-out rays rendered per check


@dataclass(frozen=True, kw_only=True)
class Numerics:
    """How numbers are computed."""

    dtype: Literal["float32", "float64"] = "float32"  # of model and training
    precision: Literal["full", "mixed"] = "full"  # mixed: hidden layers of mlp heads in bfloat16, in a float32 run


@dataclass(frozen=True, kw_only=True)
class Run:
    """How this command behaves; not part of a run's id."""

    force: bool = False
    progress: bool = True
    capture: bool = False  # on CUDA: record a step once, as CUDA graphs
    hours: PositiveFactor = 24.0  # a training that is going to take longer is refused
    preview_seconds: Annotated[float, Interval(ge=0, le=1e9)] = 30.0  # between two preview pictures; 0: none


@dataclass(frozen=True, kw_only=True)
class Density:
    """What the group density holds, besides the options of its head."""

    name: Name
    activation: Name = "trunc_exp"
    initial: PositiveFactor = 1.0  # density where the head returns 0, per world unit


@dataclass(frozen=True, kw_only=True)
class Color:
    """What the group color holds, besides the options of its head."""

    name: Name
    directions: Name = "raw"
    degree: Annotated[int, Interval(ge=1, le=4)] = 4  # of the spherical harmonics
    direction_scale: Factor = 1.0  # factor on raw directions
    direction_interval: Name = "signed"
    activation: Name = "sigmoid"


@dataclass(frozen=True, kw_only=True)
class OneHead:
    """What the group head holds, besides the options of its head."""

    name: Name
    activation: Name = "sigmoid"


HEAD_GROUPS: dict[str, type] = {"density": Density, "color": Color, "head": OneHead}
"""Group that chooses a head -> what it holds besides the options of the head, which stand under the head's name."""


@dataclass(frozen=True, kw_only=True)
class Common:
    """What the configuration of every run has: checked options, and a mapping for each component."""

    plugins: list[str] = field(default_factory=list)
    seed: Annotated[int, Interval(ge=0, le=2**63 - 2)]
    device: Name = devices.AUTO
    threads: Annotated[int, Interval(ge=1, le=1024)] | None = None
    store: Name = "runs"
    run: Run = field(default_factory=Run)
    numerics: Numerics = field(default_factory=Numerics)
    encoder: dict[str, Any]
    scene: dict[str, Any]

    def __post_init__(self) -> None:
        devices.device_of(self.device)

    @property
    def torch_device(self) -> torch.device:
        return devices.device_of(self.device)

    @property
    def dtype(self) -> torch.dtype:
        dtype: torch.dtype = getattr(torch, self.numerics.dtype)
        return dtype


@dataclass(frozen=True, kw_only=True)
class Settings(Common):
    """The configuration of a radiance field."""

    geo_features: Annotated[int, Interval(ge=0, le=2**16)] = 5
    appearance: Annotated[int, Interval(ge=0, le=2**16)] = 0
    train: Train
    render: Render = field(default_factory=Render)
    pose_noise: PoseNoise = field(default_factory=PoseNoise)
    visibility: Visibility = field(default_factory=Visibility)
    stop: Stop = field(default_factory=Stop)
    contraction: dict[str, Any]
    density: dict[str, Any]
    color: dict[str, Any]
    sampler: dict[str, Any]
    shading: dict[str, Any]
    cameras: dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class SignalSettings(Common):
    """The configuration of one head that fits a signal."""

    train: Fit
    head: dict[str, Any]


def built(kind: type[T], node: Mapping[str, Any]) -> T:
    """A dataclass of settings from a checked group; options that it lacks have their declared defaults.

    >>> built(Visibility, {"cameras": 4}).resolution
    96
    """
    values = dict(node)
    for one in fields(kind):  # type: ignore[arg-type]
        if isinstance(one.type, type) and is_dataclass(one.type) and one.name in values:
            values[one.name] = built(one.type, values[one.name])
        elif issubclass(kind, Common) and one.name in HEAD_GROUPS and one.name in values:
            declared = HEAD_GROUPS[one.name]
            names = {item.name for item in fields(declared)}
            own = declared(**{key: value for key, value in values[one.name].items() if key in names})
            values[one.name] = {**vars(own), **values[one.name]}
    return kind(**values)
