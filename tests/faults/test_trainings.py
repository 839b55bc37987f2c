"""Trainings that are killed, started twice, or meet a broken disk; QNERF_FAULTS=full runs the long form.

The full form, 100 kills and 50 pairs, a few minutes: QNERF_FAULTS=full python -m pytest tests/faults
"""

import contextlib
import json
import os
import shutil
import subprocess
import time

import pandas as pd
import pytest
import torch

from qnerf import experiment, records
from qnerf.records import StoreError, index
from qnerf.records.read import read_evaluation
from tests.helpers import processes
from tests.helpers.configs import MOMENT, TINY, composed
from tests.helpers.scenes import write_scene
from tests.helpers.stopping import At, interrupted
from tests.helpers.trainer import same

FULL = os.environ.get("QNERF_FAULTS") == "full"

SHORT = [
    *TINY, *MOMENT, "field=qcolor", "cameras=so3xr3", "appearance=2", "train.steps=30", "train.eval_every=12",
    "train.checkpoint_every=0.02", "threads=1",
]  # fmt: skip


@pytest.fixture
def job(tmp_path):
    """One or two seconds of training, with everything that a checkpoint must store."""
    overrides = ["scene=nerfstudio", f"scene.path={write_scene(tmp_path / 'scene')}", *SHORT]
    content = {"overrides": overrides, "config": composed(*overrides), "store": str(tmp_path)}
    (tmp_path / "job.json").write_text(json.dumps(content))
    return tmp_path / "job.json"


def start(*arguments):
    return processes.start("trainings", *arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def lines(process):
    out, err = process.communicate(timeout=1800)
    assert process.returncode == 0, err
    return [json.loads(line) for line in out.splitlines()]


def only_run(store):
    (run,) = records.runs(store)
    return run


def numbers(run):
    """Every logged row, without times."""
    rows = records.read_metrics(run)
    clocks = rows["key"].str.startswith("time/") | (rows["key"] == "eval/eval_s")
    return rows.loc[~clocks, ["step", "key", "value"]].reset_index(drop=True)


def assert_equal_runs(run, whole):
    """Parameters, optimiser, random streams, rows, images and results, bit for bit."""
    assert records.state(run) == "finished"
    pd.testing.assert_frame_equal(numbers(run), numbers(whole), check_exact=True)
    logged = records.read_metrics(run)
    assert not logged.duplicated(["step", "key"]).any()
    steps = logged.query("key == 'train/loss'")["step"]
    assert steps.tolist() == list(range(1, len(steps) + 1))
    mine, others = (torch.load(path / "checkpoint.pt", weights_only=True) for path in (run, whole))
    del mine["step_seconds"], others["step_seconds"]
    assert same(mine, others)
    pd.testing.assert_frame_equal(*(pd.read_parquet(path / "eval.parquet") for path in (run, whole)), check_exact=True)
    for key in ("psnr", "ssim", "steps", "params.total"):
        assert records.read_summary(run)[key] == records.read_summary(whole)[key]
    assert not list(run.rglob(".*.tmp"))


def poll(run):
    """A reader finds whole tables, no row twice, and a sensible state at any moment."""
    metrics = records.read_metrics(run)
    assert not metrics.duplicated(["step", "key"]).any()
    steps = metrics.loc[metrics["key"] == "train/loss", "step"].tolist()
    assert steps == list(range(1, len(steps) + 1))
    assert list(read_evaluation(run).columns)[:3] == ["image", "step", "psnr"]
    assert records.read_summary(run)["run_id"] == run.name
    assert records.read_config(run)["train"]["steps"] == 30
    assert records.read_status(run)["state"] in ("running", "finished")
    assert index.load(run.parent)["run_id"].tolist() == [run.name]


def test_killed_trainings_resume_to_the_same_numbers(job):
    wanted = 100 if FULL else 3
    process = start("kills", str(job), str(wanted), "0")
    polls = 0
    try:
        while process.poll() is None:
            for store in sorted(job.parent.glob("killed-*"))[-1:]:
                for run in records.runs(store):
                    poll(run)
                    polls += 1
            time.sleep(0.2)
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()
    rounds = lines(process)
    assert polls > 5
    assert sum(line["killed"] for line in rounds) == wanted
    assert [line["code"] for line in rounds] == [0] * len(rounds)
    whole = sorted(records.runs(job.parent / "whole"), key=lambda run: records.read_config(run)["seed"])
    for line in rounds:
        assert_equal_runs(only_run(job.parent / f"killed-{line['number']:03d}"), whole[line["number"] % len(whole)])
    print(f"{wanted} kills in {len(rounds)} trainings, {polls} polls")


def test_the_same_command_twice_at_once_is_one_training(job):
    """One process trains. The other says who does, with exit code 1, or that the run is finished, with 0."""
    rounds = lines(start("twins", str(job), str(50 if FULL else 2)))
    for line in rounds:
        texts = ["\n".join(output) for output in line["outputs"]]
        busy = [code for code, text in zip(line["codes"], texts, strict=True) if "already being written by" in text]
        done = [code for code, text in zip(line["codes"], texts, strict=True) if "finished already" in text]
        assert len(busy) + len(done) == 1, texts
        assert sorted(line["codes"]) == [0, len(busy)]
    runs = records.runs(job.parent / "twins")
    assert len(runs) == len(rounds)
    for run in runs:
        assert records.state(run) == "finished"
        assert numbers(run).query("key == 'train/loss'")["step"].tolist() == list(range(1, 31))
    waiting = sum("being written" in "".join(output) for line in rounds for output in line["outputs"])
    print(f"{len(rounds)} pairs, {waiting} say who trains, {len(rounds) - waiting} that the run is finished")


# Trainings that meet something broken


@pytest.fixture(scope="module")
def training(tmp_path_factory):
    """Eight steps. Its store is the one of an undisturbed run, `whole`."""
    scene = write_scene(tmp_path_factory.mktemp("scene") / "scene")
    steps = ["train.steps=8", "train.eval_every=3", "train.checkpoint_every=0"]
    store = tmp_path_factory.mktemp("whole")
    return composed("scene=nerfstudio", f"scene.path={scene}", *SHORT, *steps, f"store={store}")


@pytest.fixture(scope="module")
def whole(training):
    return experiment.run(training).path


@pytest.fixture
def config(training, tmp_path):
    return training | {"store": str(tmp_path / "runs")}


@pytest.fixture
def disk(tmp_path):
    """A folder that is a disk of three megabytes, where this process may mount one."""
    folder = tmp_path / "disk"
    folder.mkdir()
    if shutil.which("mount") is None:
        pytest.skip("there is no command `mount` here")
    command = ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    if done.returncode != 0:
        pytest.skip(f"cannot mount a small disk here: {done.stderr.strip()}")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True, timeout=20)


def test_a_full_disk_stops_the_training_and_with_room_it_goes_on(training, whole, disk):
    config = training | {"store": str(disk / "runs")}
    filler = disk / "filler"

    def fill():
        with contextlib.suppress(OSError), open(filler, "wb", buffering=0) as file:
            while True:
                file.write(bytes(4096))

    with pytest.raises(StoreError, match=r"cannot write: No space left on device$"):
        experiment.run(config, display=At(5, fill))
    run = only_run(disk / "runs")
    assert records.state(run) in ("failed", "interrupted")
    assert torch.load(run / "checkpoint.pt", weights_only=True)["step"] == 4
    assert set(range(1, 5)) <= set(numbers(run)["step"])
    filler.unlink()
    assert_equal_runs(experiment.run(config).path, whole)


def test_a_foreign_checkpoint_is_one_line_and_without_it_the_numbers_stay(config, whole):
    run = interrupted(config, 5)
    path = run / "checkpoint.pt"
    content = torch.load(path, weights_only=True)
    content["optimiser"][0]["exp_avg"] = torch.zeros(3)
    torch.save(content, path)
    foreign = path.read_bytes()
    with pytest.raises(StoreError, match=r"does not fit this run .*; delete it to try the checkpoint before") as error:
        experiment.run(config)
    assert "\n" not in str(error.value)
    assert path.read_bytes() == foreign
    path.unlink()
    assert_equal_runs(experiment.run(config).path, whole)
