"""A third kind of task, from outside the package: one class, which the runner, the store and the commands take."""

import pytest
import torch

from qnerf.cli import plugins
from qnerf.config.settings import SignalSettings
from qnerf.experiment import run
from qnerf.records import read_metrics
from qnerf.rendering.render import volume_weights
from qnerf.scenes import SCENES
from qnerf.signals import build_signal_model
from qnerf.training.evaluation import beside
from qnerf.training.stopping import Plateau
from qnerf.training.task import Task
from qnerf.training.trainer import Loop, decibels

PIXELS, SAMPLES = 12, 8


class Pulse(Task):
    """A field that also depends on time: density and colour at (x, y, t), seen along parallel rays at several times.

    A wall, as far as y = 1/2, becomes brighter; every second time is held out.
    """

    options = SignalSettings
    base = "_signal"
    headline = "psnr"

    def __init__(self, *, times: int = 4) -> None:
        self.name, self.fingerprint = "pulse", f"pulse 1 {times}"
        self.times = torch.linspace(0, 1, times)
        self.names = [f"time_{number}" for number in range(times)]
        self.eval = list(range(1, times, 2))
        self.images = self.times[:, None, None].expand(times, PIXELS, 3) * 0.8

    def description(self):
        return f"{len(self.times)} times"

    def build(self, settings):
        self.settings, self.model = settings, build_signal_model(settings, 3, 4)

    @property
    def points_a_step(self):
        return PIXELS * SAMPLES

    def render(self, view):
        """(PIXELS, 3): colours at the time of the view."""
        x, y = torch.meshgrid(torch.linspace(0, 1, PIXELS), torch.linspace(0, 1, SAMPLES), indexing="ij")
        values = self.model(torch.stack([x, y, self.times[view].expand_as(x)], -1).flatten(0, 1))
        density, color = values.view(PIXELS, SAMPLES, 4).split([1, 3], -1)
        weights = volume_weights(density.squeeze(-1).exp(), torch.full((PIXELS, SAMPLES), 1 / SAMPLES))
        return (weights[..., None] * color.sigmoid()).sum(1)

    def trainer(self, watch):
        task, shown = self, [view for view in range(len(self.times)) if view not in self.eval]

        class Steps(Loop):
            points_a_step = rays_a_step = task.points_a_step

            def terms(self, drawn):
                view = shown[self.step % len(shown)]
                return {"mse": (task.render(view) - task.images[view]).square().mean()}

        return Steps(self.model, self.settings, watch, Plateau(every=0, patience=1, min_gain_db=0.0))

    def evaluator(self, watch):
        return self

    @torch.no_grad()
    def views(self, views, step, rays=None):
        for view in views:
            shown = self.render(view)
            error = float((shown - self.images[view]).square().mean())
            yield View(view, shown), {"image": self.names[view], "psnr": decibels(error)}

    def preview(self, step):
        return self.picture(next(self.views(self.eval, step))[0])

    def picture(self, rendered):
        return beside([self.images[rendered.view][None], rendered.colors[None]])


class View:
    def __init__(self, view, colors):
        self.view, self.colors = view, colors


@pytest.fixture
def pulse(monkeypatch):
    monkeypatch.setitem(SCENES._components, "pulse", Pulse)
    return plugins.node("scene", "pulse")


def test_a_third_kind_of_task_is_one_class(fit, pulse):
    assert pulse == {"defaults": ["_signal", "_self_"], "scene": {"name": "pulse", "times": 4}}
    config = fit("scene=photograph", "train.steps=60", "encoder=none", "train.lr=0.05", "train.eval_every=20")
    config["scene"] = {"name": "pulse", "times": 5}
    outcome = run(config)
    assert outcome.state == "finished"
    assert outcome.summary["psnr"] > 20
    assert outcome.summary["eval_views"] == 2
    assert outcome.run_id.startswith("pulse-classical-none-")
    assert len(list((outcome.path / "images").glob("*.png"))) == 2
    assert "eval/psnr" in set(read_metrics(outcome.path)["key"])
    assert run(config).message  # skipped
