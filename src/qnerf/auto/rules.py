"""One rule for each option that can be `auto`: a value, and the measured numbers that it follows from."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from qnerf.auto import detail, exposure, poses, space
from qnerf.geometry.contraction import CONTRACTIONS, Box
from qnerf.scenes import Scene

Config = dict[str, Any]


@dataclass(frozen=True)
class Decision:
    """An option's value and why."""

    value: Any
    because: dict[str, float] = field(default_factory=dict)


class Measured:
    """What is measured of a scene's training data, each thing once and only when a rule asks for it."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    @cached_property
    def alpha(self) -> bool:
        return self.scene.images.shape[-1] == 4

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
        cameras = self.scene.cameras
        return 3 * len(self.scene.train) * cameras.width * cameras.height


Rule = Callable[[Measured, Config], Decision]
RULES: dict[str, Rule] = {}


def rule(*options: str) -> Callable[[Rule], Rule]:
    def add(function: Rule) -> Rule:
        RULES.update(dict.fromkeys(options, function))
        return function

    return add


@rule("contraction.name")
def contraction(of: Measured, config: Config) -> Decision:
    if of.half_extent is None:
        return Decision("linf", {"half_extent": math.nan})
    return Decision("box", {"half_extent": of.half_extent})


@rule("contraction.half_extent")
def half_extent(of: Measured, config: Config) -> Decision:
    if of.half_extent is None:
        raise ValueError("contraction.half_extent=auto: silhouettes bound no object here; give it in world units")
    return Decision(of.half_extent)


@rule("render.near")
def near(of: Measured, config: Config) -> Decision:
    if of.half_extent is not None:
        return Decision(space.hull_bounds(of.scene, of.half_extent)[0], {"half_extent": of.half_extent})
    found = of.followed.near(of.followed.cameras())
    return Decision(0.05 if found is None else found, {"first_seen": math.nan if found is None else found})


@rule("render.far")
def far(of: Measured, config: Config) -> Decision:
    if of.half_extent is not None:
        return Decision(space.hull_bounds(of.scene, of.half_extent)[1], {"half_extent": of.half_extent})
    return Decision(1000.0, {"half_extent": math.nan})


@rule("render.background")
def background(of: Measured, config: Config) -> Decision:
    return Decision("white" if of.alpha else "last_sample", {"alpha": float(of.alpha)})


@rule("visibility.cameras")
def cameras_that_see(of: Measured, config: Config) -> Decision:
    cameras = of.followed.cameras()
    return Decision(cameras, {"rays_covered": of.followed.coverage(max(cameras, 2))})


@rule("visibility.alpha")
def silhouettes(of: Measured, config: Config) -> Decision:
    return Decision(of.half_extent is not None, {"alpha": float(of.alpha)})


@rule("occupancy.every")
def occupancy(of: Measured, config: Config) -> Decision:
    return Decision(100)


EXPOSURE = 0.05  # standard deviation of the logarithm of brightness over views
EMBEDDING = 16


@rule("appearance")
def appearance(of: Measured, config: Config) -> Decision:
    return Decision(EMBEDDING if of.exposure > EXPOSURE else 0, {"exposure_spread": of.exposure, "limit": EXPOSURE})


OFF = 0.15  # pixels that the given poses may explain matches worse than the best ones; true poses stay below 0.06


@rule("cameras.name")
def refinement(of: Measured, config: Config) -> Decision:
    error = of.epipolar
    because = {"epipolar_px": error.given, "best_px": error.best, "pairs": float(error.pairs), "limit_px": OFF}
    return Decision("so3xr3" if error.given - error.best > OFF else "fixed", because)


GROWTH = 1.5  # of the resolution from one level to the next, at most
FINEST = 2048
SPARE = 2.0  # cells for each that the sampling theorem asks for: interpolation between them is linear


def unit_resolution(of: Measured, config: Config) -> float:
    """Cells an axis of the unit cube for the finest detail of the images."""
    contraction = CONTRACTIONS.build(**config["contraction"])
    side = 2 * contraction.half_extent if isinstance(contraction, Box) else 4.0  # world units along the cube
    return SPARE * side * of.cells_per_world_unit


def hash_option(config: Config, key: str) -> int:
    """An option of the hash tables, set by hand or decided before."""
    value = config["hash"][key]
    if type(value) is not int or value < 1:
        raise ValueError(f"hash.{key} must be a whole number of at least 1, got {value!r}")
    return value


@rule("hash.max_resolution")
def max_resolution(of: Measured, config: Config) -> Decision:
    coarsest, needed = hash_option(config, "min_resolution"), unit_resolution(of, config)
    because = {"cells_per_world_unit": of.cells_per_world_unit}
    return Decision(max(coarsest, min(FINEST, 16 * math.ceil(needed / 16))), because)


@rule("hash.levels")
def levels(of: Measured, config: Config) -> Decision:
    growth = hash_option(config, "max_resolution") / hash_option(config, "min_resolution")
    return Decision(1 + math.ceil(math.log(max(growth, 1)) / math.log(GROWTH)), {"growth": GROWTH})


ENTRIES_PER_VALUE = 0.5  # numbers in the tables for each observed colour value


@rule("hash.log2_table_size")
def log2_table_size(of: Measured, config: Config) -> Decision:
    entries = ENTRIES_PER_VALUE * of.observed / (hash_option(config, "levels") * hash_option(config, "features"))
    return Decision(min(19, max(10, math.floor(math.log2(max(entries, 1))))), {"observed_values": float(of.observed)})


@rule("encoder.max_exponent")
def max_exponent(of: Measured, config: Config) -> Decision:
    cycles = unit_resolution(of, config) / SPARE / 2
    return Decision(float(max(1, math.ceil(math.log2(max(cycles, 1))))), {"cycles": cycles})


@rule("encoder.bands")
def bands(of: Measured, config: Config) -> Decision:
    return Decision(int(config["encoder"]["max_exponent"]) + 2)


@rule("shading.name")
def shading(of: Measured, config: Config) -> Decision:
    return Decision("merge")
