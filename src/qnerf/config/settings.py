"""Options that belong to no component: budgets, bounds, device. Components declare their own (see registry.py)."""

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Annotated, Any, ClassVar, Literal, TypedDict, TypeVar, get_args, get_type_hints

import torch
from annotated_types import Interval, MinLen

from qnerf.config import bounds
from qnerf.config.bounds import Factor, NonNegativeFactor, NonNegativeInt, PositiveFactor, PositiveInt, Seed
from qnerf.config.registry import check_options

MAX_DEPTH = 20  # levels of groups and lists in a configuration

# Float32, in which most runs compute, has no larger or smaller numbers than about 1e38 and 1e-38.
Rate = Annotated[float, Interval(ge=1e-30, le=1e6)]
Length = Annotated[float, Interval(ge=0, le=1e9)]  # world units
Name = Annotated[str, MinLen(1)]
Background = Literal["last_sample", "white", "black", "random"]
BACKGROUNDS: tuple[str, ...] = get_args(Background)
T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """Budget and schedule of any training."""

    PARTS: ClassVar[tuple[str, ...]]  # of the model, which `rates` names

    name: Name
    steps: PositiveInt
    lr: Rate
    lr_final: Rate  # reached at the last step by exponential decay
    rates: dict[str, NonNegativeFactor]  # part of the model -> factor on the learning rate
    eps: Rate  # of Adam
    eval_every: NonNegativeInt  # steps; 0: only at the end
    log_every: PositiveInt  # steps
    checkpoint_every: Annotated[float, Interval(ge=0, le=1e9)]  # seconds

    def __post_init__(self) -> None:
        if sorted(self.rates) != sorted(self.PARTS):
            raise ValueError(f"train.rates must give a number for each of {', '.join(self.PARTS)}, got {self.rates}")


@dataclass(frozen=True, kw_only=True)
class Train(Schedule):
    """Training of a radiance field."""

    PARTS = ("encoder", "density", "color", "sampler", "cameras", "appearance")

    rays: Annotated[int, Interval(ge=1, le=2**24)]  # per step
    interlevel: NonNegativeFactor  # weight of the interlevel loss
    distortion: NonNegativeFactor  # weight of the distortion loss
    eval_views: NonNegativeInt  # views evaluated during training; 0: all
    chunk: Annotated[int, Interval(ge=1, le=2**24)]  # rays rendered at once in evaluation


@dataclass(frozen=True, kw_only=True)
class Fit(Schedule):
    """Training of one head on a signal."""

    PARTS = ("encoder", "head")

    points: Annotated[int, Interval(ge=1, le=2**24)]  # per step; all of them where the signal has no more


@dataclass(frozen=True, kw_only=True)
class Render:
    """Bounds of the rays, and the background behind them."""

    near: Length
    far: Annotated[float, Interval(gt=0, le=1e9)]  # world units
    background: Background

    def __post_init__(self) -> None:
        if not self.near < self.far:
            raise ValueError(f"render.near must be below render.far, got {self.near} and {self.far}")


@dataclass(frozen=True, kw_only=True)
class PoseNoise:
    """Noise added to the training poses."""

    rotation: Annotated[float, Interval(ge=0, le=math.tau)]  # std. dev. of each component of a rotation vector, radians
    translation: Length  # standard deviation of each coordinate
    seed: Seed


@dataclass(frozen=True, kw_only=True)
class Visibility:
    """Where density may be: cells of contracted space seen by at least `cameras` training cameras."""

    cameras: NonNegativeInt  # 0: everywhere
    alpha: bool  # also close cells where a training view is transparent
    resolution: Annotated[int, Interval(ge=2, le=512)]  # cells per axis


@dataclass(frozen=True, kw_only=True)
class Occupancy:
    """Closes cells that turn out to be empty during training."""

    every: NonNegativeInt  # steps between updates; 0: never
    after: NonNegativeInt  # steps before the first update
    min_opacity: Annotated[float, Interval(gt=0, lt=1)]  # below which a cell counts as empty


@dataclass(frozen=True, kw_only=True)
class Stop:
    """Early stopping, judged by training rays that are held out for validation."""

    every: NonNegativeInt  # steps between checks; 0: never
    patience: PositiveInt  # checks without a gain
    min_gain_db: Annotated[float, Interval(ge=0, le=1e3)]  # dB that count as a gain
    share: Annotated[float, Interval(ge=1e-9, le=0.5)]  # of the training rays, held out for validation
    rays: PositiveInt  # held-out rays rendered per check


@dataclass(frozen=True, kw_only=True)
class Numerics:
    """How numbers are computed."""

    dtype: Literal["float32", "float64"]  # of model and training
    finite_checks: bool  # stop at the first value that is not finite


@dataclass(frozen=True, kw_only=True)
class Run:
    """How this command behaves; not part of a run's id."""

    force: bool
    progress: bool
    preview_seconds: Annotated[float, Interval(ge=0, le=1e9)]  # between two preview pictures; 0: none
    debug: bool


class Component(TypedDict):
    """What every group of a component holds, besides the component's own options."""

    name: Name


class Density(Component):
    """What the group density holds, besides one group of options per kind of head."""

    activation: Name
    initial: PositiveFactor  # density where the head returns 0, per world unit
    initials: dict[str, PositiveFactor]  # head -> its default of `initial`
    rates: dict[str, NonNegativeFactor]  # head -> its default of train.rates.density


class Color(Component):
    """What the group color holds, besides one group of options per kind of head."""

    directions: Name
    degree: Annotated[int, Interval(ge=1, le=4)]  # of the spherical harmonics
    direction_scale: Factor  # factor on raw directions
    direction_interval: Name
    activation: Name
    activations: dict[str, Name]  # head -> its default of color.activation
    rates: dict[str, NonNegativeFactor]  # head -> its default of train.rates.color


class OneHead(Component):
    """What the group head holds, besides one group of options per kind of head."""

    activation: Name


COMPONENT_GROUPS: dict[str, type] = dict.fromkeys(
    ("contraction", "encoder", "scene", "sampler", "shading", "cameras"), Component
) | {"density": Density, "color": Color, "head": OneHead}
"""Group that chooses a component -> what it holds besides the component's options."""


@dataclass(frozen=True, kw_only=True)
class Common:
    """The part of the configuration that every run has: checked scalars, and one mapping per component."""

    plugins: list[str]
    experiment: Name | None
    seed: Annotated[int, Interval(ge=0, le=2**63 - 2)]
    device: Literal["auto", "cpu", "cuda"]
    threads: Annotated[int, Interval(ge=1, le=1024)] | None
    store: Name
    run: Run
    numerics: Numerics
    needs: dict[str, Any]
    qiren: dict[str, Any]
    qfgn: dict[str, Any]
    hash: dict[str, Any]
    encoder: dict[str, Any]
    scene: dict[str, Any]

    def __post_init__(self) -> None:
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


@dataclass(frozen=True, kw_only=True)
class Settings(Common):
    """The configuration of a radiance field."""

    geo_features: Annotated[int, Interval(ge=0, le=2**16)]
    appearance: Annotated[int, Interval(ge=0, le=2**16)]
    train: Train
    render: Render
    pose_noise: PoseNoise
    visibility: Visibility
    occupancy: Occupancy
    stop: Stop
    contraction: dict[str, Any]
    density: dict[str, Any]
    color: dict[str, Any]
    proposal: dict[str, Any]
    sampler: dict[str, Any]
    shading: dict[str, Any]
    cameras: dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class SignalSettings(Common):
    """The configuration of one head that fits a signal."""

    train: Fit
    head: dict[str, Any]


def schema(config: Mapping[str, Any]) -> type[Settings] | type[SignalSettings]:
    """The settings that the configuration has: with the group `head` it is a signal's."""
    return SignalSettings if "head" in config else Settings


def only_acting(config: Mapping[str, Any], overrides: Sequence[str] = ()) -> dict[str, Any]:
    """The configuration without the groups that do not act: where one head fits a signal, those of a radiance field.

    overrides: what the user typed. ValueError if one of them is for a group that does not act.
    """
    if schema(config) is Settings:
        return dict(config)
    idle = _names(Settings) - _names(SignalSettings)
    for override in overrides:
        group = re.match(r"[~+]*(?:head@)?(\w*)", override)
        if group and group[1] in {*idle, "field", "needs"}:
            acting = ", ".join(sorted(_names(SignalSettings) - {"needs"} | {"budget", "ansatz"}))
            scene = config["scene"].get("name") if isinstance(config.get("scene"), Mapping) else None
            raise ValueError(f"{override}: does not act with scene={scene}, which has one head; acting: {acting}")
    return {name: node for name, node in config.items() if name not in idle}


def _names(settings: type) -> set[str]:
    return {field.name for field in fields(settings)}


def settings_from(config: Mapping[str, Any]) -> Settings:
    """Checks the resolved configuration; ValueError names the key, the value and what was expected."""
    return _built(Settings, config)


def signal_settings_from(config: Mapping[str, Any]) -> SignalSettings:
    """As `settings_from`, for the configuration of one head that fits a signal."""
    return _built(SignalSettings, config)


def _built(kind: type[T], config: Mapping[str, Any]) -> T:
    check_settings(config)
    groups = _groups(kind)
    return kind(**{name: groups[name](**node) if name in groups else node for name, node in config.items()})


def check_settings(config: Mapping[str, Any], undecided: Collection[str] = ()) -> None:
    """ValueError unless every option that belongs to no component fits its declaration.

    undecided: dotted names of options whose value is not known yet, such as those that are `auto`.
    """
    _check_plain("config", config)
    kind = schema(config)
    _check_group("", kind, config, undecided)
    for group, component in _groups(kind).items():
        _check_group(f"{group}.", component, config[group], undecided)
    for group in filter(config.__contains__, COMPONENT_GROUPS):
        require(group, config[group], declared(group))
        for key, hint in declared(group).items():
            if f"{group}.{key}" not in undecided:
                bounds.check(f"{group}.{key}", config[group][key], hint)


def _groups(kind: type) -> dict[str, type]:
    """Group -> the dataclass that declares its options."""
    return {
        field.name: field.type for field in fields(kind) if isinstance(field.type, type) and is_dataclass(field.type)
    }


def declared(group: str) -> dict[str, Any]:
    """Option -> annotation of what a group in `COMPONENT_GROUPS` holds besides the component's options."""
    return get_type_hints(COMPONENT_GROUPS[group], include_extras=True)


def _check_group(prefix: str, component: type, node: Mapping[str, Any], undecided: Collection[str]) -> None:
    require(prefix.rstrip(".") or "config", node, [field.name for field in fields(component)])
    groups = _groups(component)
    decided = {key: value for key, value in node.items() if f"{prefix}{key}" not in undecided and key not in groups}
    check_options(prefix, component, decided)


def require(group: str, node: Any, keys: Collection[str]) -> None:
    """ValueError unless the node is a group that has the keys."""
    if not isinstance(node, Mapping):
        raise ValueError(f"{group} must be a group of options, got {node!r}")
    missing = sorted(set(keys) - set(node))
    if missing:
        raise ValueError(f"{group}: missing {', '.join(missing)}")


def _check_plain(name: str, value: Any, depth: int = 0) -> None:
    """ValueError for what no option may hold, and no file of a run: numbers that are not finite or have more than 64
    bits, text that is not Unicode, keys that are not text, groups inside groups without end."""
    if depth > MAX_DEPTH:
        raise ValueError(f"{name} is nested too deeply, in more than {MAX_DEPTH} levels")
    if isinstance(value, Mapping):
        for key, item in value.items():
            if not isinstance(key, str):
                raise ValueError(f"{name}: a key must be text, got {key!r}")
            _check_plain(key if depth == 0 else f"{name}.{key}", item, depth + 1)
    elif isinstance(value, (list, tuple)):
        for number, item in enumerate(value):
            _check_plain(f"{name}[{number}]", item, depth + 1)
    elif isinstance(value, str):
        if "\0" in value or value.encode(errors="replace").decode() != value:
            raise ValueError(f"{name} must be Unicode text without null characters, got {value!r}")
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        bounds.check(name, value, type(value))
