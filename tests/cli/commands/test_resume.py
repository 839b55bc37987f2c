"""`qnerf resume`: goes on with what was interrupted, from what is stored, and refuses what would be another run."""

import shutil

import pytest

from qnerf import experiment, records
from qnerf.cli import main
from qnerf.records import read_metrics, read_status, state, store
from tests.helpers.stopping import interrupted


@pytest.fixture
def config(tiny):
    return tiny("train.steps=6", "train.checkpoint_every=0", "threads=1")


def edit(run, change):
    """What another version, or a user, made of config.yaml."""
    config = records.read_config(run)
    change(config)
    (run / "config.yaml").write_text(store.to_yaml(config))
    return config


@pytest.fixture
def resume(qnerf):
    """`resume(run, "threads=2")`: exit code and what was said."""

    def call(run, *overrides):
        done = qnerf("resume", run.name, *overrides)
        return done.code, done.out + done.err

    return call


def losses(run):
    return read_metrics(run).query("key == 'train/loss'")["value"].tolist()


def test_resume_goes_on_with_a_failed_run(config, tmp_path, resume):
    whole = experiment.run(config | {"store": str(tmp_path / "whole")})
    run = interrupted(config, 4, RuntimeError("the machine is on fire"))
    assert state(run) == "failed"
    code, said = resume(run)
    assert code == 0
    assert "resuming at step 3" in " ".join(said.split())
    assert state(run) == "finished"
    assert losses(run) == losses(whole.path)
    assert run.name == whole.run_id


def test_resume_works_from_any_folder_and_after_a_start_with_force(config, tmp_path, monkeypatch, resume):
    """The stored configuration says store=runs and run.force=true: neither counts now."""
    monkeypatch.chdir(tmp_path)
    run = interrupted(config | {"store": "runs", "run": config["run"] | {"force": True}}, 4).resolve()
    created = read_status(run)["created"]
    monkeypatch.chdir("/")
    assert resume(run)[0] == 0
    assert state(run) == "finished"
    assert read_status(run)["created"] == created  # gone on with, not done over


def test_a_finished_run_is_left_alone(config, resume):
    run = experiment.run(config).path
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    code, said = resume(run)
    assert (code, "finished already" in said) == (0, True)
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == before


def test_how_it_is_executed_may_change_and_what_it_computes_may_not(config, resume):
    run = interrupted(config, 4)
    before = (run / "status.json").read_bytes()
    for override, message in {
        "seed=1": "seed=1: cannot change what the run computes; known: scene.path, threads, device",
        "store=elsewhere": "store=elsewhere: cannot change",
        "run.force=true": "run.force=true: cannot change",
        "threads=many": "threads",
        "threads=[": "threads=[: expected key=value",
        "device=tpu": "device",
    }.items():
        code, said = resume(run, override)
        assert (code, len(said.splitlines())) == (2, 1), said
        assert message in said
    assert (run / "status.json").read_bytes() == before
    assert resume(run, "threads=2", "device=cpu", "run.progress=false")[0] == 0
    assert state(run) == "finished"


def test_another_scene_or_configuration_is_another_run(config, tiny_scene, resume):
    run = interrupted(config, 4)
    stored = (run / "config.yaml").read_text()
    changes = {
        "config.yaml is not the configuration that the run was started with": lambda c: c["train"].update(lr=0.5),
        "train: unknown option older=2": lambda c: c["train"].update(older=2),
        "it was written by another version of qnerf": lambda c: c["train"].update(older=2),
        "contraction must be a group of options, got None": lambda c: c.update(contraction=None),
        "train must be a group of options, got [1]": lambda c: c.update(train=[1]),
    }
    for message, change in changes.items():
        edit(run, change)
        code, said = resume(run)
        assert (code, len(said.splitlines()), message in said) == (2, 1, True), said
        (run / "config.yaml").write_text(stored)
    shutil.copy(tiny_scene / "images" / "000.png", tiny_scene / "images" / "001.png")
    code, said = resume(run)
    assert code == 2
    assert f"scene.path={tiny_scene}: the scene's contents are not those that the run was started with" in said
    assert state(run) == "interrupted"


def test_a_scene_that_has_moved_is_named_anew_in_every_command(config, tiny_scene, tmp_path, resume, capsys):
    run = interrupted(config, 4)
    tiny_scene.rename(tmp_path / "moved")
    moved, store = f"scene.path={tmp_path / 'moved'}", ["--store", str(run.parent)]
    code, said = resume(run)
    assert (code, "does not exist" in said) == (2, True)
    assert "if the scene has moved, add scene.path=DIR" in said
    assert resume(run, moved)[0] == 0
    assert state(run) == "finished"
    assert records.runs(run.parent) == [run]
    for command, *options in (
        ["render", "--frames", "1", "--size", "8x8", "--out", str(tmp_path / "frames")],
        ["probe", "units"],
        ["export", "--points", "50", "--out", str(tmp_path / "points.ply")],
        ["reproduce"],
    ):
        assert main.dispatch(command, [run.name, *options, *store]) == 2, command
        assert "add scene.path=DIR" in capsys.readouterr().err
        assert main.dispatch(command, [run.name, *options, "scene.pth=x", *store]) == 2, command
        assert "scene.pth=x: cannot change what the run computes" in capsys.readouterr().err
        assert main.dispatch(command, [run.name, *options, moved, *store]) == 0, capsys.readouterr()


def test_options_that_conf_or_the_run_does_not_spell_out_are_known(tiny, resume):
    run = interrupted(tiny("train.steps=6", "contraction.name=box", "+contraction.half_extent=2.0", "threads=1"), 4)
    edit(run, lambda config: config["encoder"].pop("dense"))
    code, said = resume(run)
    assert code == 0, said
    assert state(run) == "finished"
