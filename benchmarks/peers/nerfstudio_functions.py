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
    }


def outputs(given: dict[str, Tensor]) -> dict[str, Tensor]:
    """What nerfstudio makes of the inputs."""
    return {**_space(given), **_encodings(given), **_rays(given), **_schedules()}


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

    from benchmarks.peers.nerfstudio_models import nerfacto

    optimiser = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))], lr=1e-2)
    schedule = ExponentialDecaySchedulerConfig(lr_final=1e-4, max_steps=STEPS).setup().get_scheduler(optimiser, 1e-2)
    every = range(0, STEPS, 250)
    rates = []
    for step in range(STEPS):
        if step in every:
            rates.append(optimiser.param_groups[0]["lr"])
        optimiser.step()
        schedule.step()

    model = nerfacto({"table": (2, 16, 32, 4, 1), "views": 2, "geo_features": 5, "samples": (4, 4), "final": 4})
    before, _ = model.get_training_callbacks(None)
    anneal = []
    for step in range(0, 2000, 50):
        before.func(step)
        anneal.append(model.proposal_sampler._anneal)
    numbers = {"learning rate": rates, "annealing": anneal}
    return {name: torch.tensor(values, dtype=torch.float32) for name, values in numbers.items()}


def main() -> None:
    warnings.simplefilter("ignore")
    stand_ins.install()
    torch.set_num_threads(1)
    given = inputs()
    arrays = {f"in/{name}": tensor for name, tensor in given.items()}
    arrays |= {f"out/{name}": tensor for name, tensor in outputs(given).items()}
    packed = {name: tensor.detach().numpy() for name, tensor in arrays.items()}
    small = {
        name: array.astype(np.float16 if name == "in/table" else np.int32 if array.dtype == np.int64 else array.dtype)
        for name, array in packed.items()
    }
    np.savez_compressed(sys.argv[1], **small)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
