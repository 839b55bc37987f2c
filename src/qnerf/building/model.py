"""The model of a radiance field and what it trains on, built from the settings."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from qnerf.building.components import component
from qnerf.config.settings import Settings
from qnerf.encoders import DIRECTIONS, ENCODERS
from qnerf.geometry.bounds import bounds_of
from qnerf.geometry.contraction import CONTRACTIONS, Contraction
from qnerf.geometry.hull import visual_hull
from qnerf.geometry.pose_refinement import CAMERAS
from qnerf.geometry.rays import RayTable
from qnerf.geometry.visibility import SpaceMask, crossed, visible_cells
from qnerf.heads import HEADS, Head, head_options
from qnerf.heads.activations import COLOR_ACTIVATIONS, DENSITY_ACTIVATIONS
from qnerf.heads.mlp import MLPHead
from qnerf.heads.qiren import Normalisation, check_samples
from qnerf.model.field import Field
from qnerf.model.memory import require_parameters
from qnerf.model.model import Model
from qnerf.rendering.samplers import SAMPLERS, Sampler
from qnerf.rendering.shading import SHADINGS
from qnerf.scenes import Scene


def build_head(node: Mapping[str, Any], in_dim: int, out_dim: int) -> Head:
    """The head that `node`, the group density or color, chooses."""
    return HEADS.build_checked(node["name"], in_dim, out_dim, **head_options(node))


def build_field(settings: Settings, views: int, trained: Sequence[int]) -> Field:
    """Builds contraction, encoder, density head and colour head, in the order in which a point passes them.

    views: number of views of the scene. trained: indices of the training views.
    """
    contraction = component(CONTRACTIONS, settings.contraction)
    encoder = component(ENCODERS, settings.encoder, 3)
    density = build_head(settings.density, encoder.out_dim, 1 + settings.geo_features)
    kind = settings.color["directions"]
    options = {"sh": {"degree": settings.color["degree"]}, "raw": {"scale": settings.color["direction_scale"]}}
    interval = settings.color["direction_interval"]
    directions = DIRECTIONS.build_checked(kind, interval=interval, **options.get(kind, {}))
    color_in = directions.out_dim + settings.geo_features + settings.appearance
    color = build_head(settings.color, color_in, 3)
    for head in (density, color):
        if isinstance(head, MLPHead):
            head.mixed = settings.numerics.precision == "mixed"
    activations = (
        DENSITY_ACTIVATIONS.get(settings.density["activation"]),
        COLOR_ACTIVATIONS.get(settings.color["activation"]),
    )
    initial = settings.density["initial"]
    appearance = settings.appearance
    return Field(contraction, encoder, directions, density, color, *activations, initial, views, trained, appearance)


def build_field_and_sampler(settings: Settings, scene: Scene) -> tuple[Field, Sampler]:
    field = build_field(settings, len(scene.cameras), scene.train)
    return field, component(SAMPLERS, settings.sampler, field.contraction)


def build_model(settings: Settings, scene: Scene) -> Model:
    """Field, sampler and pose refinement for the scene, in the run's dtype, on its device."""
    previous = torch.get_default_dtype()
    torch.set_default_dtype(settings.dtype)
    try:
        require_parameters(lambda: torch.nn.ModuleList(build_field_and_sampler(settings, scene)))
        torch.manual_seed(settings.seed)
        field, sampler = build_field_and_sampler(settings, scene)
        cameras = component(CAMERAS, settings.cameras, scene.cameras.poses.shape[0], scene.train)
        field.mask = sampler.mask = build_mask(settings, scene, field.contraction)
        near, far = bounds_of(scene, settings.render.near, settings.render.far)
        # Where a thin space, or one within silhouettes, starts transparent, Adam learns black fog in it before colours,
        # and they die. There is no room for the fog against which a recipe starts circuits thinner.
        length = crossed(scene, field.contraction, field.mask, near, far)
        if length < 1 or settings.visibility.alpha:
            field.initial = max(field.initial, 1 / length)
        return Model(field, sampler, cameras, component(SHADINGS, settings.shading)).to(settings.torch_device)
    finally:
        torch.set_default_dtype(previous)


def check_samples_of_a_step(settings: Settings, model: Model) -> None:
    """ValueError if a circuit head could get too few samples in a training step."""
    # With a mask, only the last sample of each ray is sure to be evaluated. Shadings make sure of enough colours.
    rendered = 1 if model.field.mask is not None else model.sampler.rendered_samples
    heads = [model.field.density_head, *([model.field.color_head] if settings.shading["name"] == "none" else [])]
    if any(isinstance(module, Normalisation) for head in heads for module in head.modules()):
        check_samples(settings.train.rays * rendered)


def build_mask(settings: Settings, scene: Scene, contraction: Contraction) -> SpaceMask | None:
    """Where density may be: seen by enough cameras, and inside the silhouettes; None: everywhere."""
    cameras, n = settings.visibility.cameras, settings.visibility.resolution
    grids = []
    if cameras:
        grids.append(visible_cells(contraction, scene.cameras, scene.train, cameras, n))
    if settings.visibility.alpha:
        grids.append(visual_hull(contraction, scene, n))
    if not grids:
        return None
    allowed = torch.stack(grids).all(0)
    if not bool(allowed.any()):
        raise ValueError("visibility: no cell is both inside the silhouettes and seen by enough cameras; turn one off")
    return SpaceMask(allowed)


def ray_table(settings: Settings, scene: Scene) -> RayTable:
    near, far = settings.render.near, settings.render.far
    stride = round(1 / settings.stop.share) if settings.stop.every else 0
    widths = math.prod(set(scene.cameras.all_sizes[:, 0].tolist()))
    while stride and math.gcd(stride, widths) > 1:  # otherwise it would hold out the same few columns of every image
        stride += 1
    return RayTable(
        scene, near=near, far=far, device=settings.torch_device, dtype=settings.dtype, validation_stride=stride
    )


def parameter_counts(model: Any) -> dict[str, int]:
    """Of what is trained."""
    counts = {
        f"params.{name}": sum(p.numel() for p in parameters if p.requires_grad)
        for name, parameters in model.parts.items()
    }
    return counts | {"params.total": sum(counts.values())}
