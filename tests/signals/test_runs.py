"""Runs that fit a signal: the same runner, ids, store, resumption and tables as radiance fields."""

import io

import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image
from rich.console import Console

from qnerf import experiment
from qnerf.building.scene import prepare
from qnerf.cli.commands import show
from qnerf.cli.display import print_outcome
from qnerf.encoders import ENCODERS
from qnerf.experiment import run
from qnerf.metrics import METRICS
from qnerf.probes import load as load_trained
from qnerf.quantum import QuantumLayer
from qnerf.records import details
from qnerf.signals import Photograph
from qnerf.timing import Stopwatch
from qnerf.training.trainer import Diverged
from tests.helpers.configs import composed

SCENES = {"scene=photograph": ("psnr", "ssim"), "scene=distance": ("distance_error", "iou", "eikonal_error")}


@pytest.mark.parametrize(("scene", "head"), [("scene=photograph", "mlp"), ("scene=distance", "qiren")])
def test_a_head_fits_a_signal(fit, scene, head):
    config = fit(scene, f"head={head}")
    outcome = run(config)
    assert outcome.state == "finished"
    assert outcome.summary["params.head"] > 0
    for key in SCENES[scene]:
        assert np.isfinite(outcome.summary[key])
    rows = pd.read_parquet(outcome.path / "eval.parquet")
    assert rows[SCENES[scene][0]].tolist() == [outcome.summary[SCENES[scene][0]]]
    (picture,) = (outcome.path / "images").glob("*.png")
    with Image.open(picture) as panels:
        assert panels.width == 3 * panels.height
    assert run(config).message  # skipped
    out = Console(file=io.StringIO(), width=200)
    print_outcome(out, outcome)
    show.show(out, details.read(outcome.path))
    assert METRICS[SCENES[scene][0]].heading.partition(",")[0] in out.file.getvalue()
    assert "held-out views" not in out.file.getvalue().partition("results")[0]


def test_every_encoder_takes_pixels_and_points_and_gives_their_gradient(fit):
    for encoder in ENCODERS.names():
        for scene in SCENES:
            task = built(fit(scene, f"encoder={encoder}"))
            points = task.scene.points[:4].float().requires_grad_()
            task.model(points).sum().backward()
            assert bool(points.grad.isfinite().all()), (scene, encoder)


def test_the_hash_grid_of_pixels_is_the_plane_z_0_of_one_of_points():
    flat, solid = (built(composed(*names, "encoder=hash", "device=cpu")).model.encoder for names in
                   (["scene=photograph"], ["scene=distance", "scene.shape=ellipsoid"]))  # fmt: skip
    solid.table.data.copy_(flat.table)
    points = torch.rand(50, 2)
    assert torch.equal(flat(points), solid(torch.nn.functional.pad(points, (0, 1))))


def test_a_colourless_run_says_so_with_options_that_it_has(fit, tiny, monkeypatch):
    monkeypatch.setattr(experiment, "EARLY", 1)
    photograph, field = fit("scene=photograph", "train.lr=1e-9"), tiny("field=classical", "train.lr=1e-9")
    for config, cure in ((photograph, "; a lower train.lr may"), (field, "a lower train.rates.color may")):
        lines = (run(config).path / "log.txt").read_text().splitlines()
        assert cure in next(line for line in lines if "colourless" in line)


def test_the_eikonal_error_is_that_of_the_gradient(fit):
    """A head that returns the sum of the coordinates, 2 x - 1 each, has a gradient of 2 sqrt(2) everywhere."""
    task = built(fit("scene=distance", "head.mlp.layers=1"))
    with torch.no_grad():
        task.model.head.net[0].weight.fill_(1.0)
    [(_, row)] = task.evaluator(task_watch(task)).views([0], 0)
    assert row["eikonal_error"] == pytest.approx(2 * 2**0.5 - 1, rel=1e-5)


def test_a_diverged_fit_names_what_is_not_finite(fit):
    task = built(fit("scene=photograph"))
    trainer = task.trainer(task_watch(task))
    with torch.no_grad():
        next(task.model.parameters()).fill_(torch.inf)
    with pytest.raises(Diverged, match=r"^model\..* is not finite after .*; the last checkpoint stays; a smaller"):
        trainer.save(None)


def built(config):
    prepared = prepare(config)
    prepared.task.build(prepared.settings)
    return prepared.task


def task_watch(task):
    return Stopwatch(torch.device("cpu"), task.model, QuantumLayer)


def test_configurations_of_signals_with_a_mistake_are_refused():
    for overrides, message in (
        (["scene=photograph", "scene.name=poster"], "scene=poster"),
        (["scene=photograph", "train=quick", "sampler=proposal"], "train: "),
        (["scene=photograph", "head.activation=relu"], "activation: unknown name 'relu'"),
        (["scene=distance", "encoder=hash", "hash=auto"], "expects int"),
    ):
        with pytest.raises(ValueError, match=message):
            run(composed(*overrides))


def test_probes_refuse_a_signal_in_one_line(fit):
    outcome = run(fit("scene=distance"))
    with pytest.raises(ValueError, match="expected a radiance field"):
        load_trained(outcome.path)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("targets", lambda y: y[:, 0], r"Photograph.targets: expected .* \(1024, C\), got float64 \(1024,\)"),
        ("targets", lambda y: y[:90], r"Photograph.targets: expected .* \(1024, C\), got float64 \(90, 3\)"),
        ("targets", lambda y: y.where(y != y[3, 0], torch.nan), "Photograph.targets: expected finite numbers, got"),
        ("targets", lambda y: y.long(), "got int64"),
        ("targets", lambda y: y.numpy(), "got ndarray"),
        ("points", lambda x: 4 * x - 2, r"Photograph.points: expected coordinates in \[0, 1\], got -1.938 to 1.938"),
        ("points", lambda x: x[:0], "Photograph.points: expected finite numbers, got 0 of 0"),
    ],
)
def test_a_signal_s_data_are_checked_when_it_is_made(fit, name, change, message):
    config = fit("scene=photograph", "scene.size=32")
    scene = Photograph(size=32)
    setattr(scene, name, change(getattr(scene, name)))
    if name == "points":
        scene.targets = scene.targets[: len(scene.points)]
    with pytest.raises(ValueError, match=message):
        prepare(config, scene)


@pytest.mark.parametrize(
    ("panels", "message"), [([], "returned no panels"), ([torch.zeros(8, 8)], r"expected a tensor \(8, W, 3\)")]
)
def test_an_evaluation_without_pictures_is_one_line(fit, monkeypatch, panels, message):
    monkeypatch.setattr(Photograph, "evaluate", lambda signal, fitted: ({"psnr": 1.0}, panels))
    with pytest.raises(ValueError, match=f"Photograph.*{message}"):
        run(fit("scene=photograph"))


def test_a_scene_that_is_none_is_one_line(fit, monkeypatch):
    monkeypatch.setattr("qnerf.building.scene.component", lambda *_: [])
    with pytest.raises(ValueError, match="scene=photograph: expected a Scene or a Task, got list"):
        prepare(fit("scene=photograph"))
