"""The same sweep on several machines over one folder: they share its runs, also the runs of a machine that dies."""

import platform
import time
from functools import partial

from qnerf import records
from qnerf.cli import sweep as sweeps
from qnerf.records import RunStore, owner
from qnerf.training.trainer import Trainer
from tests.helpers.configs import MOMENT, TINY
from tests.helpers.processes import PATIENCE, Forked, wait
from tests.helpers.scenes import write_scene

SMALL = [*TINY, *MOMENT, "scene=nerfstudio", "train.checkpoint_every=0.02", "threads=1", "run.progress=false"]


def other_machine(name, ahead=0.0, hangs_at=0):
    """Makes a process one of another machine: a host name, a boot and a clock of its own, and a short heartbeat.

    ahead: by how many seconds its clock is. hangs_at: the step that it never ends; 0: none.
    """
    clock = time.time
    platform.node = lambda: name
    owner._boot_id = lambda: name
    time.time = lambda: clock() + ahead
    owner.HEARTBEAT_LIMIT, sweeps.RETRY = 6.0, 0.2
    RunStore.__init__.__kwdefaults__.update(every=0.2)
    take_step = Trainer.take_step

    def step(self, measure):
        while self.step + 1 == hangs_at:
            time.sleep(0.1)
        return take_step(self, measure)

    Trainer.take_step = step


def test_machines_share_a_sweep_and_finish_the_run_of_one_that_died(tmp_path):
    """One of three is killed while it trains, and the clock of another one is an hour ahead."""
    store = tmp_path / "runs"
    scene = write_scene(tmp_path / "scene")
    sweep = ["run", "-m", *SMALL, f"scene.path={scene}", f"store={store}", "train.steps=40", "seed=0,1,2"]
    start = partial(Forked, *sweep, cwd=tmp_path)
    killed = start(before=partial(other_machine, "killed", hangs_at=20))
    others = []
    try:
        wait(lambda: any(records.read_metrics(run)["step"].max() == 19 for run in records.runs(store)))
        (dead,) = records.runs(store)
        others = [start(before=partial(other_machine, "right")), start(before=partial(other_machine, "ahead", 3600.0))]
        wait(lambda: len(records.runs(store)) == 3)
        killed.process.kill()
        outputs = [other.communicate(timeout=PATIENCE) for other in others]
    finally:
        for process in (killed, *others):
            process.close()
    assert [other.returncode for other in others] == [0, 0], outputs
    runs = records.runs(store)
    assert [records.state(run) for run in runs] == ["finished"] * 3
    hosts = [records.read_status(run)["host"] for run in runs]
    assert set(hosts) <= {"right", "ahead"}
    assert any(f"waiting for runs that other processes train: {dead.name} (process" in out for out, _ in outputs)
    for run in runs:
        steps = records.read_metrics(run).query("key == 'train/loss'")["step"]
        assert steps.tolist() == list(range(1, 41))
