"""Jobs of submitit, as on a Slurm cluster, on this machine: one that is warned of its time limit goes on."""

import os
import signal
import subprocess
import sys

from qnerf.records import details, read_metrics, runs, state
from tests.helpers.configs import ROOT, TINY
from tests.helpers.processes import PATIENCE, wait

STEPS = 400


def test_a_requeued_job_goes_on_from_its_checkpoint(tiny_scene, tmp_path):
    store = tmp_path / "runs"
    # No checkpoint by the clock: the one that the job goes on from is that which the signal made it write.
    budget = [f"train.steps={STEPS}", "train.checkpoint_every=1000", "train.rays=8", "train.eval_every=0"]
    options = [*TINY, "hash=C7", "train.log_every=1", "device=cpu", *budget, "scene=nerfstudio"]
    options += [f"scene.path={tiny_scene}", f"store={store}", "hydra/launcher=submitit_local"]
    command = [sys.executable, "-m", "src.run", "-m", *options]
    env = os.environ | {"PYTHONUNBUFFERED": "1"}  # the job's log says its steps at once
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, cwd=ROOT, env=env, stdout=pipe, stderr=pipe, text=True)
    wait(lambda: any((run / "environment.json").exists() for run in runs(store)), process)
    (run,) = runs(store)  # the sweep's own folder does not count as a run
    wait(lambda: any("step 40/" in log.read_text() for log in store.glob(".sweeps/*/jobs/*/*_log.out")), process)
    os.kill(details.read(run)["status"]["pid"], signal.SIGUSR2)  # as Slurm warns of the time limit
    stdout, stderr = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, stdout + stderr
    (log,) = store.glob(".sweeps/*/jobs/*/*_log.out")
    assert "going on from its checkpoint" in " ".join(log.read_text().split())
    assert state(run) == "finished"
    steps = read_metrics(run).query("key == 'train/loss'")["step"]
    assert steps.tolist() == list(range(1, STEPS + 1))
