"""nerfstudio's functions on seeded inputs: `python -m benchmarks.peers.nerfstudio_functions OUT.npz`.

Runs in nerfstudio's environment and imports nothing of qnerf. `benchmarks.nerfstudio_functions` computes the same with
ours. Keys of the file: `in/...` are inputs, `out/...` are results, all in float32 or whole numbers.
"""

import sys
import warnings
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.peers import stand_ins

RAYS = 12
NEAR, FAR = 0.05, 1000.0
HASH = {"levels": 5, "min_resolution": 16, "max_resolution": 128, "log2_table_size": 9, "features": 2}
TABLES = {  # levels, coarsest and finest resolution of the paper's hash tables and of the two proposal networks
    "C1": (16, 16, 2048),
    "C3": (12, 16, 2048),
    "C5": (12, 16, 1024),
    "C6": (8, 16, 1024),
    "proposal 1": (5, 16, 128),
    "proposal 2": (5, 16, 256),
}
STEPS = 10_000
MODEL = {"levels": 4, "min_resolution": 16, "max_resolution": 128, "log2_table_size": 7, "features": 2}
"""The field's hash grid of the model that takes a step; those of its proposal networks have as many entries."""
GEOMETRY, SAMPLES, FINAL = 5, (24, 16), 12
FINEST = (128, 256)  # of the proposal networks
UPDATES = 6000  # steps of the schedule of proposal updates
STEP = 99  # in the middle of annealing; the proposal networks learn
PARAMETERS = 10_699  # of the model


def inputs() -> dict[str, Tensor]:
    """Rays, densities, colours, points: the same for every caller."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    points = normal(96, 3) * torch.logspace(-2, 3, 96)[:, None]
    points[:4] = torch.tensor([[0.0, 0, 0], [1, 1, 1], [-1, 0.5, 0], [0, 0, 1000]])
    directions = normal(48, 3)
    return {
        "points": points,
        "directions": directions / directions.norm(dim=-1, keepdim=True),
        "unit": uniform(96, 3),
        "raw": torch.linspace(-25, 25, 51),
        "density": (2 * normal(RAYS, 48)).exp(),
        "outer density": (2 * normal(RAYS, 24)).exp(),
        "color": uniform(RAYS, 48, 3),
        "jitter": uniform(RAYS, 1),
        "table": (uniform(HASH["levels"], 2 ** HASH["log2_table_size"], HASH["features"]) - 0.5).half().float(),
        "origins": 0.2 * normal(RAYS, 3),
        "jitters": uniform(3, RAYS, 1),
        "weights": (0.5 * normal(PARAMETERS)).half().float(),
    }


def outputs(given: dict[str, Tensor]) -> dict[str, Tensor]:
    """What nerfstudio makes of the inputs."""
    return {**_space(given), **_encodings(given), **_rays(given), **_schedules(), **_step(given)}


def fill(parameters: list[torch.nn.Parameter], weights: Tensor) -> None:
    """Sets the parameters, one after the other, to the numbers of `weights`; matrices are divided by sqrt(fan-in)."""
    with torch.no_grad():
        for parameter, values in zip(parameters, weights.split([p.numel() for p in parameters]), strict=True):
            linear = parameter.ndim == 2 and parameter.shape[1] > 2
            parameter.copy_(values.view(parameter.shape) / (parameter.shape[1] ** 0.5 if linear else 1))


def _space(given: dict[str, Tensor]) -> dict[str, Tensor]:
    from nerfstudio.field_components.activations import trunc_exp
    from nerfstudio.field_components.spatial_distortions import SceneContraction

    raw = given["raw"].clone().requires_grad_()
    density: Any = trunc_exp(raw)
    (gradient,) = torch.autograd.grad(density.sum(), raw)
    contracted = SceneContraction(order=float("inf"))(given["points"])
    return {"contraction": (contracted + 2) / 4, "trunc_exp": density, "trunc_exp gradient": gradient}


def _encodings(given: dict[str, Tensor]) -> dict[str, Tensor]:
    from nerfstudio.field_components.encodings import HashEncoding, SHEncoding
    from nerfstudio.fields.base_field import get_normalized_directions

    harmonics = SHEncoding(levels=4, implementation="torch")(get_normalized_directions(given["directions"]))
    names = ("num_levels", "min_res", "max_res", "log2_hashmap_size", "features_per_level")
    grid = HashEncoding(**dict(zip(names, HASH.values(), strict=True)), implementation="torch")
    grid.hash_table.data.copy_(given["table"].flatten(0, 1))
    unit = given["unit"].clone().requires_grad_()
    encoded = grid(unit)
    to_unit, to_table = torch.autograd.grad(encoded.square().sum(), (unit, grid.hash_table))
    result = {
        "spherical harmonics": harmonics,
        "hash encoding": encoded,
        "hash encoding, gradient of points": to_unit,
        "hash encoding, gradient of table": to_table.view(given["table"].shape),
    }
    for name, (levels, coarsest, finest) in TABLES.items():
        table = HashEncoding(
            num_levels=levels, min_res=coarsest, max_res=finest, log2_hashmap_size=2, implementation="torch"
        )
        result[f"resolutions, {name}"] = table.scalings.long()
    return result


def _rays(given: dict[str, Tensor]) -> dict[str, Tensor]:
    from nerfstudio.cameras.rays import RayBundle
    from nerfstudio.model_components import losses
    from nerfstudio.model_components.ray_samplers import PDFSampler, UniformLinDispPiecewiseSampler
    from nerfstudio.model_components.renderers import AccumulationRenderer, DepthRenderer, RGBRenderer

    directions = given["directions"][:RAYS]
    bundle = RayBundle(
        origins=torch.zeros(RAYS, 3),
        directions=directions,
        pixel_area=torch.ones(RAYS, 1),
        nears=torch.full((RAYS, 1), NEAR),
        fars=torch.full((RAYS, 1), FAR),
    )
    first = UniformLinDispPiecewiseSampler(single_jitter=True).eval()(bundle, num_samples=24)
    outer = first.get_weights(given["outer density"][..., None]).requires_grad_()
    drawn = PDFSampler(include_original=False, single_jitter=True).eval()(bundle, first, outer, num_samples=48)

    # With jitter, which both samplers draw as one number per ray.
    rand, torch.rand = torch.rand, lambda *_shape, **_options: given["jitter"].clone()
    try:
        even = UniformLinDispPiecewiseSampler(single_jitter=True).train()(bundle, num_samples=24)
        jittered = PDFSampler(include_original=False, single_jitter=True).train()(bundle, first, outer, num_samples=48)
    finally:
        torch.rand = rand

    density = given["density"][..., None].clone().requires_grad_()
    weights = drawn.get_weights(density)
    (weights_gradient,) = torch.autograd.grad(weights.square().sum(), density)
    weights = weights.detach().requires_grad_()
    distortion = losses.distortion_loss([weights], [drawn])
    (distortion_gradient,) = torch.autograd.grad(distortion, weights)
    interlevel = losses.interlevel_loss([outer, weights], [first, drawn])
    (interlevel_gradient,) = torch.autograd.grad(interlevel, outer)
    return {
        "piecewise edges": _edges(first),
        "piecewise edges, jittered": _edges(even),
        "PDF edges in s": losses.ray_samples_to_sdist(drawn),
        "PDF edges in s, jittered": losses.ray_samples_to_sdist(jittered),
        "PDF edges": _edges(drawn),
        "outer weights": outer[..., 0],
        "weights": weights[..., 0],
        "weights, gradient": weights_gradient[..., 0],
        "color": RGBRenderer(background_color="last_sample").train()(rgb=given["color"], weights=weights),
        "accumulation": AccumulationRenderer()(weights=weights)[..., 0],
        "depth": DepthRenderer(method="median")(weights=weights, ray_samples=drawn)[..., 0],
        "expected depth": DepthRenderer(method="expected")(weights=weights, ray_samples=drawn)[..., 0],
        "distortion": distortion,
        "distortion, gradient": distortion_gradient[..., 0],
        "interlevel": interlevel,
        "interlevel, gradient": interlevel_gradient[..., 0],
    }


def _edges(samples: Any) -> Tensor:
    return torch.cat([samples.frustums.starts[..., 0], samples.frustums.ends[..., -1:, 0]], dim=-1)


def _schedules() -> dict[str, Tensor]:
    """The learning rate and the annealing exponent after some steps."""
    from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig

    optimiser = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))], lr=1e-2)
    schedule = ExponentialDecaySchedulerConfig(lr_final=1e-4, max_steps=STEPS).setup().get_scheduler(optimiser, 1e-2)
    every = range(0, STEPS, 250)
    rates = []
    for step in range(STEPS):
        if step in every:
            rates.append(optimiser.param_groups[0]["lr"])
        optimiser.step()
        schedule.step()

    model = _model()
    before, _ = model.get_training_callbacks(None)
    anneal = []
    for step in range(0, 2000, 50):
        before.func(step)
        anneal.append(model.proposal_sampler._anneal)
    numbers = {"learning rate": rates, "annealing": anneal}
    found = {name: torch.tensor(values, dtype=torch.float32) for name, values in numbers.items()}
    return found | {"steps of the proposal networks": _updates()}


def _updates() -> Tensor:
    """The steps in which the proposal networks learn, with the default schedule."""
    from nerfstudio.cameras.rays import RayBundle

    model = _model()
    _, after = model.get_training_callbacks(None)
    ray = torch.tensor([[0.0, 0, 1]])
    bundle = RayBundle(0 * ray, ray, torch.ones(1, 1), nears=torch.full((1, 1), NEAR), fars=torch.full((1, 1), FAR))
    learns, steps = [False], []

    def density(positions: Tensor) -> Tensor:
        learns[0] = torch.is_grad_enabled()
        return torch.ones_like(positions[..., :1])

    for step in range(UPDATES):
        model.proposal_sampler(bundle, density_fns=[density, density])
        if learns[0]:
            steps.append(step)
        after.func(step)
    return torch.tensor(steps)


def _model() -> Any:
    from benchmarks.peers.nerfstudio_models import nerfacto

    table = [MODEL[key] for key in ("levels", "min_resolution", "max_resolution", "log2_table_size", "features")]
    networks = [
        {"hidden_dim": 16, "log2_hashmap_size": table[3], "num_levels": 5, "max_res": finest, "use_linear": False}
        for finest in FINEST
    ]
    options = {"near_plane": NEAR, "far_plane": FAR, "proposal_net_args_list": networks}
    settings = {"table": table, "views": 2, "geo_features": GEOMETRY, "samples": SAMPLES, "final": FINAL}
    return nerfacto(settings | {"options": options}).train()


def _step(given: dict[str, Tensor]) -> dict[str, Tensor]:
    """The loss terms of one training step of a small Nerfacto, and the gradients of all parameters."""
    from nerfstudio.cameras.rays import RayBundle

    model = _model()
    names = dict(model.named_parameters())
    parts = ["field.mlp_base", "field.mlp_head", "proposal_networks.0", "proposal_networks.1"]
    groups = [[p for name, p in names.items() if name.startswith(part)] for part in parts]
    fill([p for group in groups for p in group], given["weights"])
    before, _ = model.get_training_callbacks(None)
    before.func(STEP)
    bundle = RayBundle(
        given["origins"],
        given["directions"][:RAYS],
        torch.ones(RAYS, 1),
        camera_indices=torch.zeros(RAYS, 1, dtype=torch.int64),
        nears=torch.full((RAYS, 1), NEAR),
        fars=torch.full((RAYS, 1), FAR),
    )
    draws = iter(given["jitters"])
    rand, torch.rand = torch.rand, lambda shape, **_options: next(draws).clone().reshape(shape)
    try:
        found = model(bundle)
    finally:
        torch.rand = rand
    batch = {"image": given["color"][:, 0]}
    terms = model.get_loss_dict(found, batch, model.get_metrics_dict(found, batch))
    sum(terms.values()).backward()
    loss = torch.stack([terms[f"{name}_loss"] for name in ("rgb", "distortion", "interlevel")])
    gradients = {
        f"a step, gradient of {name}": torch.cat([p.grad.flatten() for p in group])
        for name, group in zip(("density", "color", "proposal 1", "proposal 2"), groups, strict=True)
    }
    return {"a step, loss": loss, **gradients}


def main() -> None:
    warnings.simplefilter("ignore")
    stand_ins.install()
    torch.set_num_threads(1)
    given = inputs()
    arrays = {f"in/{name}": tensor for name, tensor in given.items()}
    arrays |= {f"out/{name}": tensor for name, tensor in outputs(given).items()}
    packed = {name: tensor.detach().numpy() for name, tensor in arrays.items()}
    small = {
        name: array.astype(
            np.float16 if name in ("in/table", "in/weights") else np.int32 if array.dtype == np.int64 else array.dtype
        )
        for name, array in packed.items()
    }
    np.savez_compressed(sys.argv[1], **small)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
