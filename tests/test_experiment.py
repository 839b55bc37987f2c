"""A run from start to end: what it leaves, how it resumes, how it stops."""

import contextlib
import json
import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image

from qnerf import experiment
from qnerf.building import acting, configuration
from qnerf.building.scene import prepare
from qnerf.cli import compose
from qnerf.cli.python import run as qnerf_run
from qnerf.cli.training import train
from qnerf.experiment import run
from qnerf.records import read_config, read_metrics, read_status, runs, state
from qnerf.training import forecast, lpips
from qnerf.training.evaluation import Evaluator
from qnerf.training.preview import Preview
from qnerf.training.trainer import Diverged, Trainer
from tests.helpers.scenes import write_scene
from tests.helpers.stopping import StopsWhen, interrupted

REQUIRED = [
    "run_id", "state", "params.encoder", "params.density", "params.color", "psnr", "ssim", "lpips", "train_s",
    "step_ms", "steps", "field", "encoder", "hash", "scene", "sampler", "cameras", "train", "scene.path",
    "train.steps", "train.rays", "seed", "geo_features",
]  # fmt: skip
OWN = {
    "classical": ["color.mlp.layers", "color.mlp.width", "density.mlp.layers", "density.mlp.width"],
    "qboth": ["qiren", "density.qiren.layers", "color.qiren.spectral"],
}
"""Field -> columns that other fields do not have."""


def parameters(path):
    return torch.load(path / "checkpoint.pt", weights_only=True)["model"]


def logged(path):
    rows = read_metrics(path)
    timeless = rows[~rows["key"].str.startswith("time/") & (rows["key"] != "eval/eval_s")]
    return timeless[["step", "key", "value"]].reset_index(drop=True)


def test_a_copy_a_backup_and_an_export_are_not_the_run(tiny, tmp_path):
    prepared = prepare(tiny())
    name = prepared.find_id(tmp_path)
    digest = name.rpartition("-")[2]
    for folder, named in (
        (f"a-backup-{name}", name),
        (f"a-export-{digest}", None),
        (f"a-old-{digest}", f"a-old-{digest}"),
    ):
        (tmp_path / folder).mkdir()
        if named:
            (tmp_path / folder / "status.json").write_text(json.dumps({"run_id": named}))
    assert prepared.find_id(tmp_path) == f"a-old-{digest}"  # the same scene under its old name
    (tmp_path / name).mkdir()
    assert prepared.find_id(tmp_path) == name


def test_a_configuration_is_worked_out_once_and_a_stored_one_once_more(tiny, monkeypatch):
    calls = []
    monkeypatch.setattr(configuration, "options", lambda config: (calls.append(config), acting.options(config))[1])
    overrides = ("field=qcolor", "train.steps=3")
    started = tiny(*overrides)
    monkeypatch.setattr(compose, "configuration", lambda _: started)
    steps = iter([False, False, True])
    train(configuration.Configuration.of(started), overrides, StopsWhen(lambda: next(steps)))
    assert len(calls) == 1
    assert qnerf_run(*overrides).state == "finished"
    assert len(calls) == 1 + 2


def test_steps_that_are_left_to_the_scene_are_numbers_in_the_summary(tiny):
    """`train=large` is a recipe of its own; tables and lists compute with the number of steps."""
    config = tiny("train=large", "train.steps=auto", "hash=auto", "field=classical")
    outcome = run(config, display=StopsWhen(lambda: True))
    assert outcome.summary["train.steps"] == 3000
    assert read_config(outcome.path)["train"]["steps"] == 3000
    assert pd.read_parquet(outcome.path / "summary.parquet")["train.steps"].dtype == "int64"
    again = run(config, display=StopsWhen(lambda: True))
    assert (again.run_id, again.state) == (outcome.run_id, "interrupted")


@pytest.mark.parametrize("field", ["classical", "qboth"])
def test_a_finished_run_leaves_what_pandas_reads(tiny, field):
    outcome = run(tiny(f"field={field}", "train.steps=4"))
    summary = pd.read_parquet(outcome.path / "summary.parquet")
    assert len(summary) == 1
    assert {*REQUIRED, *OWN[field]} <= set(summary.columns)
    assert not set(OWN["qboth" if field == "classical" else "classical"]) & set(summary.columns)
    row = summary.iloc[0]
    assert (row["state"], row["field"], row["steps"], row["run_id"]) == ("finished", field, 4, outcome.run_id)
    assert row["step_ms"] > 0
    assert row["step_cpu_ms"] > 0
    assert row["time.threads"] == torch.get_num_threads()
    assert len(row["machine"]) == 8
    assert row["loops"] == "all compiled"
    assert row["time.load"] >= 0
    assert state(outcome.path) == "finished"

    metrics = pd.read_parquet(outcome.path / "metrics")
    assert list(metrics.columns) == ["step", "time_s", "key", "value"]
    assert metrics.query("key == 'train/loss'")["step"].tolist() == [1, 2, 3, 4]
    assert (metrics.query("key == 'time/quantum_ms'")["value"] > 0).all() == (field == "qboth")

    evaluated = pd.read_parquet(outcome.path / "eval.parquet")
    assert {"image", "psnr", "ssim", "lpips"} <= set(evaluated.columns)
    assert row["psnr"] == pytest.approx(evaluated["psnr"].mean())
    pictures = sorted((outcome.path / "images").glob("*.png"))
    assert len(pictures) == len(evaluated)
    assert np.asarray(Image.open(pictures[0])).shape == (240, 4 * 320, 3)


def test_pictures_are_there_after_the_first_evaluation(tiny):
    config = tiny("train.steps=6", "train.eval_every=2", "train.eval_views=1")
    folder = interrupted(config, 3)
    assert len(list((folder / "images").glob("*.png"))) == 1


def test_the_curve_is_of_the_same_evenly_spread_views_throughout(tiny, tmp_path):
    said = []

    class Heard(experiment.Display):
        def phase(self, name):
            said.append(name)

        def held_out(self, step, metric, psnr, views):
            said.append((step, psnr, views))

    scene = write_scene(tmp_path / "views", views=60)
    options = ["train.steps=4", "train.eval_every=2", "train.eval_views=2", f"scene.path={scene}"]
    path = run(tiny(*options), display=Heard()).path
    curve = read_metrics(path).query("key == 'eval/psnr'")["value"].tolist()
    final = pd.read_parquet(path / "eval.parquet")["psnr"]
    assert len(final) == 6
    assert curve[-1] == pytest.approx(final.iloc[[1, 4]].mean())
    assert [item for item in said if isinstance(item, tuple)] == [
        (2, curve[0], "2 of 6 views"),
        (4, curve[1], "2 of 6 views"),
    ]
    phases = [item for item in said if isinstance(item, str)]
    assert phases[:4] == ["train", "train", "evaluate 1 of 2 views", "evaluate 2 of 2 views"]
    assert phases[-2:] == ["evaluate 5 of 6 views", "evaluate 6 of 6 views"]


def test_an_interrupted_run_has_a_preview_which_changes_no_number(tiny, tmp_path):
    options = ["field=qboth", "cameras=so3xr3", "appearance=2", "train.steps=6", "train.eval_every=2"]
    options += ["qiren.shots=20", "qiren.noise.two_qubit=0.01", "qiren.qubits=2"]
    seldom = run(tiny(*options, f"store={tmp_path / 'seldom'}", "run.preview_seconds=0"))
    assert not (seldom.path / "preview.png").exists()
    always = tiny(*options, f"store={tmp_path / 'always'}", "run.preview_seconds=1e-9")
    steps = iter(range(100))
    stopped = run(always, display=StopsWhen(lambda: next(steps) > 2))
    assert stopped.state == "interrupted"
    assert np.asarray(Image.open(stopped.path / "preview.png")).shape == (240, 4 * 320, 3)
    often = run(always)
    assert often.run_id == seldom.run_id
    mine, others = parameters(often.path), parameters(seldom.path)
    assert all(torch.equal(mine[name], others[name]) for name in mine)
    pd.testing.assert_frame_equal(logged(often.path), logged(seldom.path))


def test_a_run_says_where_its_world_is(tiny):
    outcome = run(tiny())
    content = json.loads((outcome.path / "dataparser_transforms.json").read_text())
    stored = torch.tensor(content["transform"], dtype=torch.float64)
    scene = prepare(tiny()).scene
    torch.testing.assert_close(content["scale"] * stored, scene.transform[:3])
    torch.testing.assert_close(stored[:, :3] @ stored[:, :3].T, torch.eye(3, dtype=torch.float64))


def test_a_resumed_run_repeats_the_uninterrupted_one_bit_for_bit(tiny, tmp_path):
    """Also the step at which it no longer gains."""
    options = ["field=qboth", "qiren.qubits=2", "cameras=so3xr3", "appearance=2", "train.steps=12"]
    options += ["train.eval_every=2"]
    options += ["stop.every=2", "stop.share=0.1", "stop.rays=9", "stop.patience=2", "stop.min_gain_db=50"]
    options += ["train.cooldown=1", "train.error_rays=0.5"]
    whole = run(tiny(*options, f"store={tmp_path / 'whole'}"))
    parts = tiny(*options, f"store={tmp_path / 'parts'}", "train.checkpoint_every=0")
    interrupted(parts, 6)
    torch.rand(3)  # whatever the process did in between
    resumed = run(parts)

    assert (resumed.state, resumed.summary["steps"], resumed.summary["stopped"]) == ("finished", 6, "plateau")
    mine, others = parameters(resumed.path), parameters(whole.path)
    assert mine.keys() == others.keys()
    assert all(torch.equal(mine[name], others[name]) for name in mine)
    pd.testing.assert_frame_equal(logged(resumed.path), logged(whole.path))
    columns = ["image", "psnr", "ssim"]
    pd.testing.assert_frame_equal(
        pd.read_parquet(resumed.path / "eval.parquet")[columns], pd.read_parquet(whole.path / "eval.parquet")[columns]
    )


@pytest.mark.parametrize("stop_at", [2, 4])
def test_a_stop_request_ends_an_evaluation_which_the_resumed_run_repeats(tiny, tmp_path, monkeypatch, stop_at):
    scene = write_scene(tmp_path / "views", views=20)
    options = ["train.steps=4", "train.eval_every=2", "train.eval_views=0", f"scene.path={scene}"]
    whole = run(tiny(*options, f"store={tmp_path / 'whole'}"))
    parts = tiny(*options, f"store={tmp_path / 'parts'}")
    requests = []

    def views(self, chosen, step, rays=None, original=Evaluator.views):
        for number, item in enumerate(original(self, chosen, step, rays)):
            if step == stop_at and number == 0:
                requests.append(2)
            yield item

    with monkeypatch.context() as patch:
        patch.setattr(experiment, "stop_requests", lambda _: contextlib.nullcontext(requests))
        patch.setattr(Evaluator, "views", views)
        outcome = run(parts)
    assert (outcome.state, state(outcome.path)) == ("interrupted", "interrupted")
    assert f"stopped at step {stop_at} of 4" in outcome.message
    assert torch.load(outcome.path / "checkpoint.pt", weights_only=True)["step"] == stop_at
    assert "eval/psnr" not in set(read_metrics(outcome.path).query("step == @stop_at")["key"])
    resumed = run(parts)
    assert resumed.state == "finished"
    pd.testing.assert_frame_equal(logged(resumed.path), logged(whole.path))
    assert resumed.summary["psnr"] == whole.summary["psnr"]


@pytest.mark.parametrize("at", [3, 6])
def test_a_process_that_is_ended_in_a_slow_loop_has_the_last_whole_step(tiny, tmp_path, monkeypatch, at):
    """Within a preview, or within the last evaluation: the resumed run repeats the uninterrupted one bit for bit."""
    whole = experiment.run(tiny("train.steps=6", f"store={tmp_path / 'whole'}"))
    asked = []
    monkeypatch.setattr(experiment, "SLOW", 0.0)
    monkeypatch.setattr(experiment, "stop_requests", lambda words: contextlib.nullcontext(asked.append(words) or []))
    render = Evaluator.render

    def ended(evaluator, view, step, stride=1):
        if step == at:
            assert asked[0]() == f"stopped at step {at} of 6; the same command continues from there"
            raise KeyboardInterrupt
        return render(evaluator, view, step, stride)

    with monkeypatch.context() as patch:
        patch.setattr(Evaluator, "render", ended)
        patch.setattr(Preview, "refresh", lambda own, step, now=False: own.draw(step))
        with pytest.raises(KeyboardInterrupt):
            experiment.run(tiny("train.steps=6"))
    (path,) = runs(tiny()["store"])
    assert state(path) == "interrupted"
    resumed = experiment.run(tiny("train.steps=6"))
    assert resumed.summary["psnr"] == whole.summary["psnr"]


def test_a_training_that_takes_too_long_is_refused_with_the_option_that_goes_on(tiny, tmp_path, monkeypatch):
    """Before the first step by what circuits cost, and else from a step; a short one says nothing."""
    notes = []

    class Notes(experiment.Display):
        def note(self, text):
            notes.append(text)

    with pytest.raises(ValueError, match=r"circuits alone: a step takes about .*, more than run.hours=24; run.hours="):
        experiment.run(tiny("qiren.qubits=40", "train.rays=512", "train.steps=100000"))
    assert not Path(tiny()["store"]).exists()
    with pytest.raises(ValueError, match=r"^a step takes about .*, more than run.hours=1e-06; run.hours=1 goes on"):
        experiment.run(tiny("train.steps=5", "run.hours=1e-6"))
    assert experiment.run(tiny("train.steps=5", "run.hours=1"), display=Notes()).state == "finished"
    assert not any("a step takes" in note for note in notes)
    monkeypatch.setattr(forecast, "WORTH_A_LINE", 0.0)
    experiment.run(tiny("train.steps=5", f"store={tmp_path / 'said'}"), display=Notes())
    assert [note for note in notes if "a step takes" in note]
    experiment.run(tiny("train.steps=5", "run.hours=1e-6"))  # it is finished


def test_too_few_samples_for_a_circuit_leave_no_run(tiny):
    config = tiny("field=qboth", "qiren=1L1S", "train.rays=1", "sampler=uniform", "sampler.samples=1")
    with pytest.raises(ValueError, match="normalises over the samples of a step: expected at least 2, got 1"):
        run(config)
    assert not Path(config["store"]).exists()


def test_a_loss_that_turns_nan_names_step_and_part_and_keeps_the_last_good_checkpoint(tiny, monkeypatch):
    take_step = Trainer.take_step

    def poisoned(self, measure):
        if self.step == 3:
            with torch.no_grad():
                next(self.model.field.color_head.parameters()).fill_(math.nan)
        return take_step(self, measure)

    monkeypatch.setattr(Trainer, "take_step", poisoned)
    config = tiny("train.steps=6", "train.checkpoint_every=0")
    with pytest.raises(Diverged, match="nan at step 3, in the parameters of 'color'"):
        run(config)
    (folder,) = runs(config["store"])
    assert read_status(folder)["state"] == "failed"
    assert "step 3" in read_status(folder)["error"]
    checkpoint = torch.load(folder / "checkpoint.pt", weights_only=True)
    assert checkpoint["step"] == 3
    assert all(torch.isfinite(value).all() for value in checkpoint["model"].values())


def test_images_with_alpha_need_a_background_of_known_colour(tiny, tmp_path):
    folder = write_scene(tmp_path / "rgba", channels=4)
    with pytest.raises(ValueError, match=r"use render\.background=random"):
        run(tiny("scene=nerfstudio", f"scene.path={folder}"))
    for background in ("white", "random"):
        assert (
            run(tiny("scene=nerfstudio", f"scene.path={folder}", f"render.background={background}")).state == "finished"
        )


def test_parameters_beyond_memory_are_refused_before_anything_is_written(monkeypatch, tiny, tmp_path):
    monkeypatch.setattr("qnerf.config.memory.available_bytes", lambda: 2**16)
    with pytest.raises(ValueError, match=r"training [\d,]+ parameters would take .* are available; reduce"):
        run(tiny("field=classical", "hash.log2_table_size=15"))
    assert not (tmp_path / "runs").exists()


def test_weights_of_lpips_that_cannot_be_read_are_refused_before_anything_is_written(monkeypatch, tiny, tmp_path):
    for name in (lpips.BACKBONE, lpips.HEADS):
        (tmp_path / name).write_text("no weights")
    monkeypatch.setenv(lpips.VARIABLE, str(tmp_path))
    with pytest.raises(ValueError, match=r"expected torchvision's .* of LPIPS"):
        run(tiny("field=classical"))
    assert not (tmp_path / "runs").exists()
