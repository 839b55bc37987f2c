"""One small finished run, shared by the tests of this folder."""

import dataclasses

import pytest
import torch

from qnerf.experiment import run
from qnerf.probes import load
from qnerf.viewing.frames import Renderer
from tests.helpers.configs import MOMENT, TINY, composed
from tests.helpers.scenes import write_scene

CENTRE, RADIUS = torch.tensor([0.1, -0.05, 0.0]), 0.4


@pytest.fixture(scope="session")
def tiny_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("viewing")
    scene = write_scene(folder / "scene", width=12, height=8)
    own = ("scene=nerfstudio", f"scene.path={scene}", f"store={folder / 'runs'}", "train.steps=3")
    return run(composed(*TINY, *MOMENT, *own)).path


@pytest.fixture(scope="session")
def trained(tiny_run):
    return load(tiny_run)


@pytest.fixture
def ball(trained, monkeypatch):
    """The tiny run's renderer with a field that is a coloured ball, dense inside."""
    field = trained.model.field

    def raw_at(unit, inside, *, last=True):
        points = field.contraction.inverse(unit)
        density = 4000 * torch.sigmoid(60 * (RADIUS - (points - CENTRE).norm(dim=-1)))
        return torch.cat([density[..., None].log(), points], dim=-1), None

    monkeypatch.setattr(field, "raw_at", raw_at)
    monkeypatch.setitem(field._modules, "mask", None)
    monkeypatch.setattr(field, "color", lambda points, *_: (points + 1) / 2)
    settings = dataclasses.replace(
        trained.settings, render=dataclasses.replace(trained.settings.render, background="white")
    )
    return Renderer(dataclasses.replace(trained, settings=settings))
