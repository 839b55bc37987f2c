"""nerfstudio's Nerfacto as a served model: `python -m benchmarks.peers.nerfstudio_models RAYS.npz SETTINGS`.

Runs in nerfstudio's environment; `benchmarks.cpu_ladder` writes the file and the JSON of the settings. The model is
built from nerfstudio's own classes, trained on the batches of pixels that the file lists, with nerfstudio's callbacks
and schedule of the learning rate, on the CPU in float32. What differs from nerfstudio's own training loop: rays come
from a table, and the PSNR of each batch is not computed.
"""

import json
import sys
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.peers import stand_ins
from benchmarks.peers.serve import serve

CHUNK = 2048  # rays rendered at once in evaluation


def nerfacto(settings: Mapping[str, Any]) -> Any:
    """nerfstudio's Nerfacto in its PyTorch implementation, without an appearance embedding and with fixed poses.

    Args:
        settings: `table` (levels, coarsest and finest resolution, log2 of the table size, features), `views`,
            `geo_features`, `samples`, `final`, `options`.
    """
    from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
    from nerfstudio.data.scene_box import SceneBox
    from nerfstudio.fields.nerfacto_field import NerfactoField
    from nerfstudio.models.nerfacto import NerfactoModelConfig

    names = ("num_levels", "base_res", "max_res", "log2_hashmap_size", "features_per_level")
    grid = dict(zip(names, settings["table"], strict=True)) | {"implementation": "torch"}
    config = NerfactoModelConfig(
        **grid,
        num_proposal_samples_per_ray=tuple(settings["samples"]),
        num_nerf_samples_per_ray=settings["final"],
        use_appearance_embedding=False,
        camera_optimizer=CameraOptimizerConfig(mode="off"),
        **settings["options"],
    )
    box = SceneBox(aabb=torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
    model = config.setup(scene_box=box, num_train_data=settings["views"])
    # Its configuration has no option for the number of geometry features.
    model.field = NerfactoField(
        box.aabb,
        num_images=settings["views"],
        geo_feat_dim=settings["geo_features"],
        appearance_embedding_dim=0,
        spatial_distortion=model.field.spatial_distortion,
        **grid,
    )
    return model


class Nerfstudio:
    """Trains the model as nerfstudio's trainer does, one batch of the table's pixels a step.

    Args:
        table: `origins` (V, 3), `directions` (V P, 3), `colors` (V P, 3) uint8, `batches` (steps, R): row-major numbers
            of training pixels among all V P, and `held_out`: the views to render.
        settings: of `nerfacto`, and `seed`, `rate`, `final_rate` (a fraction of the rate), `eps`, `steps`, `near`,
            `far`.
    """

    def __init__(self, table: Mapping[str, np.ndarray], settings: Mapping[str, Any]) -> None:
        from nerfstudio.engine.callbacks import TrainingCallbackLocation as At
        from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig

        self.settings = settings
        self.table = {name: torch.from_numpy(array) for name, array in table.items()}
        self.pixels = len(self.table["colors"]) // len(self.table["origins"])
        torch.manual_seed(settings["seed"])
        self.model = nerfacto(settings)
        callbacks = self.model.get_training_callbacks(None)
        self.before = [call for call in callbacks if At.BEFORE_TRAIN_ITERATION in call.where_to_run]
        self.after = [call for call in callbacks if At.AFTER_TRAIN_ITERATION in call.where_to_run]
        self.optimisers, self.schedules = [], []
        rate = settings["rate"]
        for group in filter(None, self.model.get_param_groups().values()):
            optimiser = torch.optim.Adam(group, lr=rate, eps=settings["eps"])
            final = rate * settings["final_rate"]
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
        return RayBundle(
            origins=self.table["origins"][views],
            directions=self.table["directions"][numbers],
            pixel_area=ones,
            camera_indices=views[:, None],
            nears=ones * self.settings["near"],  # given: its default in evaluation is 0
            fars=ones * self.settings["far"],
        )

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
        self.model.eval()
        names = {"color": "rgb", "depth": "depth", "accumulation": "accumulation"}
        views: dict[str, list[Tensor]] = {name: [] for name in names}
        for view in self.table["held_out"].tolist():
            numbers = torch.arange(view * self.pixels, (view + 1) * self.pixels)
            parts = [self.model(self.bundle(part)) for part in numbers.split(CHUNK)]
            for name, key in names.items():
                views[name].append(torch.cat([part[key] for part in parts]).squeeze(-1))
        np.savez(path, **{name: torch.stack(own).numpy() for name, own in views.items()})  # type: ignore[arg-type]


def main() -> None:
    warnings.simplefilter("ignore")
    stand_ins.install()
    table, settings = dict(np.load(sys.argv[1])), json.loads(sys.argv[2])
    torch.set_num_threads(settings["threads"])
    serve(lambda: Nerfstudio(table, settings))


if __name__ == "__main__":
    main()
