"""One rule per option that can be `auto`: it returns a value and the measurements behind it."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from qnerf.auto import detail, exposure, poses, space
from qnerf.geometry.contraction import CONTRACTIONS
from qnerf.geometry.rays import TrainingPixels
from qnerf.scenes import Scene

Config = dict[str, Any]
AUTO = "auto"
"""The value of an option that a rule decides."""


@dataclass(frozen=True)
class Decision:
    """The value of an option, and the measurements behind it."""

    value: Any
    because: dict[str, float] = field(default_factory=dict)


class Measured:
    """Measurements of a scene's training data; each is made once, when a rule first needs it."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    @cached_property
    def half_extent(self) -> float | None:
        return space.box_half_extent(self.scene)

    @cached_property
    def followed(self) -> space.Followed:
        return space.Followed(self.scene)

    @cached_property
    def exposure(self) -> float:
        return exposure.exposure_spread(self.scene)

    @cached_property
    def epipolar(self) -> poses.Epipolar:
        return poses.epipolar_error(self.scene)

    @cached_property
    def cells_per_world_unit(self) -> float:
        return detail.cells_per_world_unit(self.scene)

    @cached_property
    def observed(self) -> int:
        """Colour values in the training images."""
        return 3 * len(TrainingPixels(self.scene))


Rule = Callable[[Measured, Config], Decision]
RULES: dict[str, Rule] = {}


def rule(*options: str) -> Callable[[Rule], Rule]:
    def add(function: Rule) -> Rule:
        RULES.update(dict.fromkeys(options, function))
        return function

    return add


@rule("contraction.name")
def contraction(data: Measured, config: Config) -> Decision:
    if data.half_extent is None:
        return Decision("linf", {"half_extent": math.nan})
    return Decision("box", {"half_extent": data.half_extent})


@rule("contraction.half_extent")
def half_extent(data: Measured, config: Config) -> Decision:
    if data.half_extent is None:
        raise ValueError("contraction.half_extent=auto: silhouettes bound no object here; set it in world units")
    return Decision(data.half_extent)


@rule("render.near")
def near(data: Measured, config: Config) -> Decision:
    if data.half_extent is not None:
        return Decision(space.hull_bounds(data.scene, data.half_extent)[0], {"half_extent": data.half_extent})
    distance = data.followed.near(data.followed.cameras())
    return Decision(0.05 if distance is None else distance, {"first_seen": math.nan if distance is None else distance})


@rule("render.far")
def far(data: Measured, config: Config) -> Decision:
    if data.half_extent is not None:
        return Decision(space.hull_bounds(data.scene, data.half_extent)[1], {"half_extent": data.half_extent})
    return Decision(1000.0, {"half_extent": math.nan})


@rule("render.background")
def background(data: Measured, config: Config) -> Decision:
    return Decision("white" if data.scene.has_alpha else "last_sample", {"alpha": float(data.scene.has_alpha)})


@rule("visibility.cameras")
def cameras_that_see(data: Measured, config: Config) -> Decision:
    cameras = data.followed.cameras()
    return Decision(cameras, {"rays_covered": data.followed.coverage(max(cameras, 2))})


@rule("visibility.alpha")
def silhouettes(data: Measured, config: Config) -> Decision:
    return Decision(data.half_extent is not None, {"alpha": float(data.scene.has_alpha)})


EXPOSURE = 0.05  # standard deviation over views of the log brightness above which each view gets an embedding
EMBEDDING = 16


@rule("appearance")
def appearance(data: Measured, config: Config) -> Decision:
    return Decision(EMBEDDING if data.exposure > EXPOSURE else 0, {"exposure_spread": data.exposure, "limit": EXPOSURE})


@rule("cameras.name")
def refinement(data: Measured, config: Config) -> Decision:
    error = data.epipolar
    because = {"epipolar_px": error.given, "best_px": error.best, "pairs": float(error.pairs), "limit_px": poses.OFF}
    return Decision("so3xr3" if error.given - error.best > poses.OFF else "fixed", because)


GROWTH = 1.5  # largest ratio of the resolutions of neighbouring levels
FINEST = 2048
OVERSAMPLING = 2.0  # cells per cell of the sampling theorem, because interpolation is only linear


def unit_resolution(data: Measured, config: Config) -> float:
    """Cells per axis of the unit cube that resolve the finest detail of the images where the cameras look."""
    options = dict(config["contraction"])
    contraction = CONTRACTIONS.build(options.pop("name"), **options)
    side = detail.world_units_along_the_cube(contraction, detail.focus_point(data.scene))
    return OVERSAMPLING * side * data.cells_per_world_unit


def hash_option(config: Config, key: str) -> int:
    """An option of the hash tables that the user set or an earlier rule decided."""
    value = config["encoder"][key]
    if type(value) is not int or value < 1:
        raise ValueError(f"encoder.{key} must be a whole number of at least 1, got {value!r}")
    return value


@rule("encoder.max_resolution")
def max_resolution(data: Measured, config: Config) -> Decision:
    coarsest, needed = hash_option(config, "min_resolution"), unit_resolution(data, config)
    because = {"cells_per_world_unit": data.cells_per_world_unit}
    return Decision(max(coarsest, min(FINEST, 16 * math.ceil(needed / 16))), because)


@rule("encoder.levels")
def levels(data: Measured, config: Config) -> Decision:
    growth = hash_option(config, "max_resolution") / hash_option(config, "min_resolution")
    return Decision(1 + math.ceil(math.log(max(growth, 1)) / math.log(GROWTH)), {"growth": GROWTH})


PIXELS, STEPS, MOST_STEPS = 100_000, 3000, 30_000  # training pixels for which the quick recipe's steps suffice


@rule("train.steps")
def steps(data: Measured, config: Config) -> Decision:
    pixels = data.observed / 3
    needed = STEPS * max(1.0, pixels / PIXELS) ** 0.25
    return Decision(min(MOST_STEPS, 100 * round(needed / 100)), {"pixels": pixels})


SHARE_BESIDE_BACKGROUND = 0.75  # of the rays, where an object stands before a background that is soon learnt


@rule("train.error_rays")
def error_rays(data: Measured, config: Config) -> Decision:
    alpha = data.scene.has_alpha
    return Decision(SHARE_BESIDE_BACKGROUND if alpha else 0.0, {"alpha": float(alpha)})


NUMBERS_PER_VALUE = 1.0  # in all tables, for each colour value that training sees


@rule("encoder.log2_table_size")
def log2_table_size(data: Measured, config: Config) -> Decision:
    train = config["train"]
    values = float(min(data.observed, 3 * train["rays"] * train["steps"]))
    entries = NUMBERS_PER_VALUE * values / (hash_option(config, "levels") * hash_option(config, "features"))
    return Decision(min(19, max(10, math.floor(math.log2(max(entries, 1))))), {"seen_values": values})


@rule("encoder.max_exponent")
def max_exponent(data: Measured, config: Config) -> Decision:
    cycles = unit_resolution(data, config) / OVERSAMPLING / 2
    return Decision(float(max(1, math.ceil(math.log2(max(cycles, 1))))), {"cycles": cycles})


@rule("encoder.bands")
def bands(data: Measured, config: Config) -> Decision:
    return Decision(int(config["encoder"]["max_exponent"]) + 2)


@rule("shading.name")
def shading(data: Measured, config: Config) -> Decision:
    return Decision("merge")
