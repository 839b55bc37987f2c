"""nerfstudio's models as served ones: `python -m benchmarks.peers.nerfstudio_models RAYS.npz SETTINGS.json`.

Runs in nerfstudio's environment. The files are written by `benchmarks.nerfstudio`. The model is built from nerfstudio's
own classes, trained on the batches of pixels that the first file lists, with nerfstudio's callbacks and schedule of the
learning rate, on the CPU in float32. What differs from nerfstudio's own training loop: rays come from a table, and the
PSNR of each batch is not computed.
"""

import json
import sys
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from benchmarks.peers import stand_ins
from benchmarks.peers.serve import serve

CHUNK = 2048  # rays rendered at once in evaluation


def nerfacto(settings: Mapping[str, Any]) -> Any:
    """nerfstudio's Nerfacto in its PyTorch implementation, without an appearance embedding and with fixed poses.

    Args:
        settings: `table` (levels, coarsest and finest resolution, log2 of the table size, features), `views`,
            `geo_features`, `samples`, `final`; `circuit` (layers, spectral) for the published quantum colour head.
    """
    from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
    from nerfstudio.data.scene_box import SceneBox
    from nerfstudio.models.nerfacto import NerfactoModelConfig

    levels, coarsest, finest, log2_size, features = settings["table"]
    config = NerfactoModelConfig(
        implementation="torch",
        num_levels=levels,
        base_res=coarsest,
        max_res=finest,
        log2_hashmap_size=log2_size,
        features_per_level=features,
        num_proposal_samples_per_ray=tuple(settings["samples"]),
        num_nerf_samples_per_ray=settings["final"],
        use_appearance_embedding=False,
        camera_optimizer=CameraOptimizerConfig(mode="off"),
        **settings.get("options", {}),
    )
    box = SceneBox(aabb=torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
    model = config.setup(scene_box=box, num_train_data=settings["views"])
    # Its configuration has no option for the number of geometry features.
    model.field = _field(box.aabb, settings, config, model.field.spatial_distortion)
    return model


def _field(aabb: Tensor, settings: Mapping[str, Any], config: Any, contraction: nn.Module) -> nn.Module:
    from nerfstudio.fields.nerfacto_field import NerfactoField

    options = {
        "num_images": settings["views"],
        "geo_feat_dim": settings["geo_features"],
        "num_levels": config.num_levels,
        "base_res": config.base_res,
        "max_res": config.max_res,
        "log2_hashmap_size": config.log2_hashmap_size,
        "features_per_level": config.features_per_level,
        "appearance_embedding_dim": 0,
        "spatial_distortion": contraction,
        "implementation": "torch",
    }
    field = NerfactoField(aabb, **options)
    if settings.get("circuit"):
        # The head gets the directions themselves, moved to [0, 1], in place of their spherical harmonics.
        field.direction_encoding = nn.Identity()
        field.mlp_head = quantum_head(3 + settings["geo_features"], 3, *settings["circuit"])
    return field


def quantum_head(in_dim: int, out_dim: int, layers: int, spectral: int, qubits: int = 8) -> nn.Module:
    """The published head "xL+yS": Linear, BatchNorm1d, circuit, x + 1 times, then a Linear; no activation.

    The circuit is qnerf's, with angles drawn from U[0, 2 pi].
    """
    from qnerf.quantum import QuantumLayer

    steps: list[nn.Module] = []
    for _ in range(layers + 1):
        steps += [nn.Linear(in_dim, qubits), nn.BatchNorm1d(qubits), QuantumLayer(qubits, spectral)]
        in_dim = qubits
    return nn.Sequential(*steps, nn.Linear(in_dim, out_dim))


def tensorf(settings: Mapping[str, Any]) -> Any:
    """nerfstudio's TensoRF with the options of its own configuration, and with fixed poses.

    Args:
        settings: `half_extent` of the cube that holds the scene, in world units; `views`; `background`.
    """
    from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
    from nerfstudio.data.scene_box import SceneBox
    from nerfstudio.models.tensorf import TensoRFModelConfig

    config = TensoRFModelConfig(
        regularization="tv",
        camera_optimizer=CameraOptimizerConfig(mode="off"),
        background_color=settings["background"],
    )
    half = settings["half_extent"]
    box = SceneBox(aabb=torch.tensor([[-half] * 3, [half] * 3]))
    return config.setup(scene_box=box, num_train_data=settings["views"])


class Nerfstudio:
    """Trains the model as nerfstudio's trainer does, one batch of the table's pixels a step.

    Args:
        table: `origins` (V, 3), `directions` (V P, 3), `colors` (V P, 3) uint8, `batches` (steps, R): row-major numbers
            of training pixels among all V P, and `held_out`: the views to render.
        settings: of `nerfacto` or, with `rates`, of `tensorf`; and `seed`, `rate` or `rates` (by group of parameters),
            `final_rate` (a fraction of the rate), `eps`, `steps`, `near`, `far`.
    """

    def __init__(self, table: Mapping[str, np.ndarray], settings: Mapping[str, Any]) -> None:
        from nerfstudio.engine.callbacks import TrainingCallbackLocation
        from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig

        self.settings = settings
        self.table = {name: torch.from_numpy(array) for name, array in table.items()}
        self.pixels = len(self.table["colors"]) // len(self.table["origins"])
        torch.manual_seed(settings["seed"])
        self.model = tensorf(settings) if "rates" in settings else nerfacto(settings)
        callbacks = self.model.get_training_callbacks(None)
        at = TrainingCallbackLocation
        self.before = [call for call in callbacks if at.BEFORE_TRAIN_ITERATION in call.where_to_run]
        self.after = [call for call in callbacks if at.AFTER_TRAIN_ITERATION in call.where_to_run]
        self.optimisers, self.schedules = [], []
        for name, group in self.model.get_param_groups().items():
            if group:
                rate = settings["rates"][name] if "rates" in settings else settings["rate"]
                final = rate * settings["final_rate"]
                optimiser = torch.optim.Adam(group, lr=rate, eps=settings["eps"])
                decay = ExponentialDecaySchedulerConfig(lr_final=final, max_steps=settings["steps"]).setup()
                self.optimisers.append(optimiser)
                self.schedules.append(decay.get_scheduler(optimiser, rate))
        self.step = 0
        self.model.train()

    def bundle(self, numbers: Tensor) -> Any:
        """Rays through the pixels (R,)."""
        from nerfstudio.cameras.rays import RayBundle

        views = torch.div(numbers, self.pixels, rounding_mode="floor")
        ones = torch.ones(len(numbers), 1)
        bounded = "half_extent" in self.settings  # the box gives the bounds
        return RayBundle(
            origins=self.table["origins"][views],
            directions=self.table["directions"][numbers],
            pixel_area=ones,
            camera_indices=views[:, None],
            nears=None if bounded else ones * self.settings["near"],  # given: its default in evaluation is 0
            fars=None if bounded else ones * self.settings["far"],
        )

    def advance(self, step: int) -> None:
        self.step = step

    def take_step(self) -> None:
        numbers = self.table["batches"][self.step % len(self.table["batches"])].long()
        batch = {"image": self.table["colors"][numbers].float() / 255}
        for callback in self.before:
            callback.run_callback(step=self.step)
        for optimiser in self.optimisers:
            optimiser.zero_grad()
        outputs = self.model(self.bundle(numbers))
        metrics = self.model.get_metrics_dict(outputs, batch)
        loss = sum(self.model.get_loss_dict(outputs, batch, metrics).values())
        loss.backward()
        for optimiser in self.optimisers:
            if any(parameter.grad is not None for group in optimiser.param_groups for parameter in group["params"]):
                optimiser.step()
        for schedule in self.schedules:
            schedule.step()
        for callback in self.after:
            callback.run_callback(step=self.step)
        self.step += 1

    @torch.no_grad()
    def render(self, path: str) -> None:
        sampler = getattr(self.model, "proposal_sampler", None)
        waiting = getattr(sampler, "_steps_since_update", None)  # rendering resets it
        self.model.eval()
        views = []
        for view in self.table["held_out"].tolist():
            numbers = torch.arange(view * self.pixels, (view + 1) * self.pixels)
            parts = [self.model(self.bundle(part)) for part in numbers.split(CHUNK)]
            names = {"color": "rgb", "depth": "depth", "accumulation": "accumulation"}
            views.append({name: torch.cat([part[key] for part in parts]) for name, key in names.items()})
        self.model.train()
        if sampler is not None:
            sampler._steps_since_update = waiting
        color = torch.stack([view["color"] for view in views])
        depth, accumulation = (torch.stack([view[name][:, 0] for view in views]) for name in ("depth", "accumulation"))
        np.savez(path, color=color.numpy(), depth=depth.numpy(), accumulation=accumulation.numpy())


def main() -> None:
    warnings.simplefilter("ignore")
    stand_ins.install()
    table, settings = np.load(sys.argv[1]), json.loads(sys.argv[2])
    import nerfstudio.models.nerfacto
    import nerfstudio.models.tensorf  # noqa: F401 (their memory does not count)

    if settings.get("circuit"):
        import qnerf.quantum  # noqa: F401

    torch.set_num_threads(settings["threads"])
    arrays = dict(table)
    serve(lambda: Nerfstudio(arrays, settings))


if __name__ == "__main__":
    main()
