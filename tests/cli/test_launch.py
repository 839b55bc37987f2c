"""Trainings and sweeps from the command line: what they say, stopped, shared with others."""

import contextlib
import errno
import os
import signal
import sys
import time

import pytest
import torch

from qnerf import experiment
from qnerf.cli import launch, main, sweep_start
from qnerf.cli import sweep as sweeps
from qnerf.cli.ends import stoppable
from qnerf.cli.errors import is_known, report
from qnerf.cli.sweep import Sweep
from qnerf.cli.training import train
from qnerf.config import devices
from qnerf.experiment import Outcome
from qnerf.records import RunStore, StoreError, read_config, read_metrics, read_summary, runs, state
from qnerf.training.stop_requests import stop_requests
from qnerf.training.trainer import Trainer
from tests.helpers.processes import Forked, call, wait
from tests.helpers.stores import vanish


def states(store):
    return sorted(state(path) for path in runs(store))


def steps(path):
    return read_metrics(path).query("key == 'train/loss'")["step"].tolist()


def training(store, jobs=1):
    """Whether so many runs have logged a step."""
    return lambda: sum(len(read_metrics(run)) > 0 for run in runs(store)) == jobs


def test_a_start_says_what_is_trained_and_an_end_what_came_of_it(qnerf, small):
    done = qnerf("run", *small, "train.steps=3", "qfgn.scale=2")
    assert done.code == 0, done.err
    start = done.out.partition("step 1/3")[0].splitlines()
    assert len(start) <= 12
    said = {line.split()[0]: line for line in start}
    assert "held out" in said["scene"]
    assert int(said["density"].split()[-2].replace(",", "")) > 0
    assert "mlp" in said["density"]
    assert "train.steps=3" in said["changed"]
    assert "runs/" in said["run"]
    assert "qfgn" not in said["changed"]
    assert done.err == "note: no effect with the chosen components: qfgn.scale=2\n"
    for word in ("PSNR", "SSIM", "parameters", "encoder", "training"):
        assert word in done.out
    again = qnerf("run", *small, "train.steps=3", "qfgn.scale=2")
    assert (again.code, "scene" in again.out.split()) == (0, False)


def test_cfg_job_prints_the_configuration_that_acts(qnerf, small):
    done = qnerf("run", *small, "--cfg", "job")
    assert done.code == 0, done.err
    assert "log2_table_size: 13" in done.out
    assert "qiren" not in done.out
    unfinished = qnerf("run", "scene=nerfstudio", "--cfg", "job")
    assert (unfinished.code, "path: ???" in unfinished.out) == (0, True)
    assert unfinished.err == "note: not complete: scene.path must be given\n"


def test_a_sweep_says_how_many_different_runs_it_trains_and_a_failure_stops_none(qnerf, small, tmp_path):
    options = ["train.steps=1", "field=classical,qcolor", "qiren.layers=1,0", "qiren.qubits=3", "qfgn.scale=2"]
    done = qnerf("run", "-m", *[item for item in small if not item.startswith("field")], *options)
    assert done.out.startswith("4 jobs, 3 different runs\n")
    assert "\nnote: no effect in any job: qfgn.scale\n" in done.out
    assert done.code == 1
    assert "1 failed" in done.err
    assert "layers must be between 1 and 64, got 0" in " ".join(done.err.split())
    assert states(tmp_path / "runs") == ["finished"] * 2


@pytest.mark.filterwarnings("ignore")  # Hydra's about schemas, which the command itself leaves out
def test_a_missing_launcher_or_search_is_one_line(qnerf, monkeypatch):
    monkeypatch.setattr(
        sweep_start, "EXTRAS", {name: ("no_such_module", extra) for name, (_, extra) in sweep_start.EXTRAS.items()}
    )
    for option, extra in (("hydra/launcher=submitit_local", "slurm"), ("hydra/sweeper=qnerf_optuna", "search")):
        done = qnerf("run", "-m", "seed=0,1", option)
        assert (done.code, f'pip install "qnerf[{extra}]"' in done.err, done.err.count("\n")) == (2, True, 1)


# Runs that another process trains


@pytest.fixture
def held(qnerf, small, tmp_path):
    """The run of `small`, interrupted, and now written by this process."""
    assert qnerf("run", *small, "train.steps=3").code == 0
    (path,) = runs(tmp_path / "runs")
    claim = RunStore(tmp_path / "runs", every=60).claim(path.name, read_config(path), force=True)
    assert claim.run is not None
    return claim.run


def test_a_run_that_another_process_trains_is_exit_code_1(qnerf, small, held):
    done = qnerf("run", *small, "train.steps=3")
    assert done.code == 1
    assert "being written by process" in done.out
    held.interrupt()


@pytest.mark.parametrize("end", ["dies", "finishes"])
def test_a_sweep_goes_back_to_runs_whose_process_died(qnerf, small, held, tmp_path, monkeypatch, end):
    monkeypatch.setattr(sweeps, "RETRY", 0.05)
    looks = []

    def look(path):
        looks.append(path)
        if len(looks) == 3:
            vanish(held) if end == "dies" else held.finish({"psnr": 1.0})
        return state(path)

    monkeypatch.setattr(sweeps, "state", look)
    done = qnerf("run", "-m", *small, "train.steps=3,2")
    assert done.code == 0, done.err
    assert f"waiting for runs that other processes train: {held.dir.name}" in done.out
    assert states(tmp_path / "runs") == ["finished"] * 2
    assert (read_summary(held.dir)["psnr"] == 1.0) == (end == "finishes")


def test_a_finished_run_waits_for_no_gpu(qnerf, small, monkeypatch):
    assert qnerf("run", *small).code == 0
    monkeypatch.setattr(devices, "known", lambda: ["cuda:0", "cpu"])
    monkeypatch.setattr(devices, "_take", lambda *_: pytest.fail("it asks for a GPU"))
    done = qnerf("run", *small, "device=auto")
    assert (done.code, "finished" in done.out) == (0, True), done.err


def test_a_cluster_does_not_wait_and_says_what_is_left(tmp_path, capsys):
    run = RunStore(tmp_path / "runs", every=60).claim("a", {"seed": 0}).run
    sweep = Sweep(tmp_path / "sweep")
    sweep.busy(3, ["seed=0"], run.dir)
    assert launch._report(sweep) == 1
    assert f"other processes train them: a (process {os.getpid()} on " in capsys.readouterr().err
    run.finish()


@pytest.mark.parametrize(("restarts", "calls"), [(None, 1), ("1", 3)])
def test_a_restarted_job_waits_for_the_heartbeat_of_the_one_that_died(monkeypatch, tmp_path, config, restarts, calls):
    outcomes = [Outcome("run", tmp_path, state, {}, "") for state in ("busy", "busy", "finished")]
    done = []
    monkeypatch.setattr(experiment, "run", lambda *_, **__: done.append(outcomes[len(done)]) or done[-1])
    monkeypatch.setattr("qnerf.cli.training.RETRY", 0.0)
    monkeypatch.delenv("SLURM_RESTART_COUNT", raising=False)
    if restarts:
        monkeypatch.setenv("SLURM_RESTART_COUNT", restarts)
    train(config(), [], experiment.Display())
    assert len(done) == calls


def test_threads_come_from_slurm(qnerf, monkeypatch):
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "many")
    assert qnerf("run").err == "error: SLURM_CPUS_PER_TASK must be a whole number, got 'many'\n"
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "100000")
    assert "threads must be between 1 and 1024, got 100000" in qnerf("run").err


# What jobs report


def test_failures_come_in_the_order_of_the_jobs_without_what_all_have_in_common(tmp_path):
    sweep = Sweep(tmp_path / "sweep", ["field=qcolor", "seed=0,1"])
    assert sweep.failures() == []
    for job in (10, 2):
        Sweep(tmp_path / "sweep").fail(job, ["field=qcolor", f"seed={job}"], f"reason {job}")
    assert sweep.failures() == [("seed=2", "reason 2"), ("seed=10", "reason 10")]


# How a training ends


def write_often():
    """Slow steps, and rows on the disk at once: a training is not over before others see it."""
    RunStore.__init__.__kwdefaults__["every"] = 0.1
    take_step = Trainer.take_step
    Trainer.take_step = lambda self, measure: time.sleep(0.02) or take_step(self, measure)


@pytest.fixture
def start():
    """Starts `qnerf run`."""
    started = []

    def begin(*arguments):
        started.append(Forked("run", *arguments, before=write_often))
        return started[-1]

    yield begin
    for process in started:
        process.close()


@pytest.mark.usefixtures("signals")
@pytest.mark.parametrize("how", ["SIGINT", "stdout"])
def test_a_training_stops_with_a_checkpoint_and_the_same_command_goes_on(start, small, tmp_path, how):
    arguments = [*small, "train.steps=200", "train.eval_every=50", "train.eval_views=1", "threads=1"]
    process = start(*arguments)
    wait(training(tmp_path / "runs"))
    process.stdout.close() if how == "stdout" else process.send_signal(getattr(signal, how))
    errors = process.stderr.read()
    process.wait(timeout=300)
    assert process.returncode == (141 if how == "stdout" else 130)
    assert errors.endswith("the same command continues from there\n")
    assert errors.count("\n") == 1
    (run,) = runs(tmp_path / "runs")
    assert state(run) == "interrupted"
    assert (run / "checkpoint.pt").is_file()
    if how == "SIGINT":
        assert call("run", *arguments).returncode == 0
        assert steps(run) == list(range(1, 201))


@pytest.mark.usefixtures("signals")
def test_a_second_request_ends_at_once_and_the_handlers_are_restored():
    before = sys.stdout, sys.stderr, signal.getsignal(signal.SIGTERM)
    with stoppable(), stop_requests() as stops:
        for _ in range(3):  # a terminal that closes sends it more than once
            signal.raise_signal(signal.SIGHUP)
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert stops == [signal.SIGHUP] * 3 + [signal.SIGTERM]
    assert (sys.stdout, sys.stderr, signal.getsignal(signal.SIGTERM)) == before


@pytest.mark.usefixtures("signals")
def test_a_command_ends_also_where_a_library_has_swallowed_the_interrupt(monkeypatch):
    ended = []

    def swallow():
        with contextlib.suppress(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(60)
        for _ in range(6000):
            time.sleep(0 if ended else 0.01)

    monkeypatch.setattr("qnerf.training.stop_requests.GRACE", 0.0)
    monkeypatch.setattr("qnerf.cli.ends.end", ended.append)
    monkeypatch.setattr("qnerf.cli.launch.run_command", swallow)
    main.run()
    assert ended[0] == "stopped"


def test_an_ignored_hangup_stays_ignored():
    previous = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stoppable(), stop_requests() as stops:
            signal.raise_signal(signal.SIGHUP)
        assert stops == []
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, previous)


def test_a_stop_while_the_scene_is_read_leaves_no_run(qnerf, small, tmp_path, monkeypatch):
    monkeypatch.setattr(experiment, "run", lambda *_, **__: signal.raise_signal(signal.SIGTERM))
    done = qnerf("run", *small)
    assert (done.code, done.err) == (130, "stopped\n")
    assert not (tmp_path / "runs").exists()


def test_a_full_disk_forgets_no_job_of_a_sweep(tmp_path, monkeypatch):
    def full(path, *arguments, **options):
        raise StoreError(f"{path}: cannot write: No space left on device") from OSError(errno.ENOSPC, "no space")

    first = Sweep(tmp_path)
    first.fail(0, ["seed=0"], "diverged")
    monkeypatch.setattr(sweeps, "replace", full)
    Sweep(tmp_path).fail(1, ["seed=1"], "full")
    assert first.failures() == [("seed=0", "diverged"), ("seed=1", "full")]
    sweeps._unwritten.clear()  # as in another process
    assert first.failures() == [("seed=0", "diverged"), ("job 1", "the disk had no room for the reason")]


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (
            torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB\nsee docs"),
            1,
            "not enough memory: CUDA",
        ),
        (RuntimeError("MPS backend out of memory"), 1, "not enough memory: MPS"),
        (OSError(errno.ENOSPC, "No space left on device"), 1, "No space left"),
        (ValueError("wrong"), 2, "wrong"),
    ],
)
def test_shortages_are_one_line_and_exit_code_1(capsys, error, code, said):
    assert is_known(error)
    assert report(error) == code
    err = capsys.readouterr().err
    assert said in err
    assert err.count("\n") == 1
