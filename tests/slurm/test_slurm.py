"""A sweep on a real Slurm cluster on the loopback, one job pre-empted, the other warned of its time limit."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pandas as pd
import pytest

from qnerf.experiment import run
from qnerf.records import read_metrics, read_summary, runs
from tests.helpers.configs import ROOT, TINY, composed
from tests.helpers.slurm_cluster import cluster, missing

pytest.importorskip("hydra_plugins.hydra_submitit_launcher", reason='needs pip install "qnerf[slurm]"')
pytestmark = pytest.mark.skipif(missing() is not None, reason=f"no Slurm cluster here: {missing()}")

STEPS = 400
SECONDS = 150  # until a hanging queue fails the test


@pytest.fixture(scope="module")
def slurm() -> Iterator[dict[str, str]]:
    """The environment in which Slurm's commands find the cluster."""
    with cluster(cpus=2) as conf:
        yield os.environ | {"SLURM_CONF": str(conf)}


def wait(ready: Callable[[], bool], process: subprocess.Popen) -> None:
    deadline = time.monotonic() + SECONDS
    while not ready():
        assert process.poll() is None, "the sweep ended before its time"
        assert time.monotonic() < deadline
        time.sleep(0.1)


def sweep(overrides: list[str], store: Path, slurm: dict[str, str]) -> subprocess.Popen:
    launcher = ["hydra/launcher=submitit_slurm", "hydra.launcher.cpus_per_task=1", "hydra.launcher.timeout_min=30"]
    command = [sys.executable, "-m", "src.run", "-m", *launcher, *overrides, f"store={store}", "seed=0,1"]
    return subprocess.Popen(command, cwd=ROOT, env=slurm, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def started(store: Path) -> list[Path]:
    return [path for path in runs(store) if (path / "environment.json").exists()]


def training(path: Path) -> pd.DataFrame:
    """What a run logged, without the clock."""
    logged = read_metrics(path)
    clock = logged["key"].str.startswith("time/") | (logged["key"] == "eval/eval_s")
    return logged[~clock][["step", "key", "value"]].reset_index(drop=True)


def test_requeued_jobs_go_on_from_their_checkpoints_to_the_same_numbers(slurm, tiny_scene, tmp_path):
    scene = ["scene=nerfstudio", f"scene.path={tiny_scene}"]
    # No checkpoint by the clock: the ones that jobs go on from are those that the signals made them write.
    budget = [f"train.steps={STEPS}", "train.checkpoint_every=1000", "train.rays=8", "train.eval_every=0"]
    overrides = [*TINY, "hash=C7", "train.log_every=1", "device=cpu", *scene, *budget]
    store = tmp_path / "runs"
    process = sweep(overrides, store, slurm)
    wait(lambda: len(started(store)) == 2, process)
    time.sleep(0.5)  # some steps

    def call(*command: str) -> str:
        return subprocess.run(command, env=slurm, capture_output=True, text=True, timeout=60, check=True).stdout

    preempted, limited = sorted(call("squeue", "-h", "-r", "-o", "%F_%K").split())
    call("scontrol", "requeue", preempted)  # as pre-emption does: SIGTERM, then back into the queue
    call("scancel", "--signal=USR2", limited)  # as Slurm warns of the time limit
    stdout, stderr = process.communicate(timeout=SECONDS)
    assert process.returncode == 0, stdout + stderr

    for job in (preempted, limited):
        (log,) = store.glob(f".sweeps/*/jobs/{job}/*_log.out")
        assert "going on from its checkpoint" in " ".join(log.read_text().split())
    assert len(runs(store)) == 2, "the sweep's own folder does not count as a run"
    for seed, path in enumerate(sorted(runs(store), key=lambda path: read_summary(path)["seed"])):
        whole = run(composed(*overrides, f"seed={seed}", f"store={tmp_path / 'whole'}", "threads=1"))
        assert path.name == whole.run_id
        pd.testing.assert_frame_equal(training(path), training(whole.path), check_exact=True)
        assert read_summary(path)["psnr"] == whole.summary["psnr"]
        steps = read_metrics(path).query("key == 'train/loss'")["step"]
        assert steps.tolist() == list(range(1, STEPS + 1))
