"""The training of a radiance field on posed images."""

from collections.abc import Mapping, Sequence

from qnerf import auto
from qnerf.auto import exposure, poses
from qnerf.building.configuration import Configuration
from qnerf.building.model import build_model, check_samples_of_a_step, ray_table
from qnerf.config.settings import PoseNoise, Settings, built
from qnerf.geometry.bounds import bounds_of, described_bounds
from qnerf.geometry.pose_noise import add_pose_noise
from qnerf.model.model import Model
from qnerf.scenes import Scene
from qnerf.timing import Stopwatch
from qnerf.training import lpips
from qnerf.training.evaluation import Evaluator, colormap
from qnerf.training.task import Task
from qnerf.training.trainer import Trainer


class FieldTask(Task):
    """Trains a radiance field on posed images."""

    options = Settings
    headline = Scene.headline
    brings_color = "render.background=random, a larger density.initial or a lower train.rates.color"
    settings: Settings
    model: Model

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self.name, self.fingerprint, self.eval, self.names = scene.name, scene.fingerprint, scene.eval, scene.names
        self.transform = scene.transform

    @property
    def scene(self) -> Scene:
        """The images with the poses that training sees."""
        return self._scene

    def decide(self, configuration: Configuration) -> tuple[Configuration, Mapping[str, auto.Decision]]:
        """Adds the noise of poses, then decides every `auto`."""
        noise = built(PoseNoise, configuration.complete["pose_noise"])
        scene = self._scene = add_pose_noise(self.scene, **vars(noise))
        scene.require_pixels()
        decided, decisions = auto.resolve(configuration.complete, scene)
        if decisions:
            configuration = Configuration.of(decided)
        settings = configuration.settings
        assert isinstance(settings, Settings)
        check_background(scene, settings)
        bounds_of(scene, settings.render.near, settings.render.far)
        # With bounds that hold anyway, and without them, it is one run.
        implied = dict(zip(("render.near", "render.far"), bounds_of(scene, None, None), strict=True))
        unneeded = {name: None for name, value in implied.items() if configuration[name] == value}
        return configuration.with_values(unneeded), decisions

    def description(self) -> str:
        return self.scene.description()

    def build(self, settings: Settings) -> None:
        self.settings = settings
        self.model = build_model(settings, self.scene)
        check_samples_of_a_step(settings, self.model)
        self.table = ray_table(settings, self.scene)
        self.curve_views = settings.train.eval_views
        self.columns = {"render.near": self.table.near, "render.far": self.table.far}  # what acts
        # Files that cannot be used are reported now, not at the first evaluation.
        lpips.weights()
        colormap()

    @property
    def points_a_step(self) -> int:
        return self.settings.train.rays * self.model.sampler.rendered_samples

    def trainer(self, watch: Stopwatch) -> Trainer:
        return Trainer(self.model, self.table, self.settings, watch)

    def evaluator(self, watch: Stopwatch) -> Evaluator:
        background, chunk = self.settings.render.background, self.settings.train.chunk
        return Evaluator(self.scene, self.table, self.model, background=background, chunk=chunk, watch=watch)

    def notes(self) -> str:
        return described_bounds(self.scene, self.table.near, self.table.far)

    def doubts(self) -> list[str]:
        return [doubt for doubt in (poses.warning(self.scene), exposure.warning(self.scene)) if doubt]

    def rays_of(self, views: Sequence[int]) -> int:
        return int(self.scene.cameras.all_sizes[list(views)].prod(1).sum())


def check_background(scene: Scene, settings: Settings) -> None:
    if scene.has_alpha and settings.render.background == "last_sample":
        raise ValueError(
            f"scene {scene.name}: the images have alpha, which render.background=last_sample cannot be compared with; "
            "use render.background=random, or white or black, in front of which a pale or dark object may not form"
        )
