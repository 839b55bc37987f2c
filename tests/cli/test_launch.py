"""Sweeps: jobs side by side, failures, kills and Ctrl-C, and what a scheduler's job does."""

import io
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest

from qnerf import experiment
from qnerf.cli import launch
from qnerf.cli.launch import _Prefixed, _require
from qnerf.cli.sweep import Sweep
from qnerf.experiment import Outcome
from qnerf.records import read_metrics, runs, state
from qnerf.training.stop_requests import stop_requests
from tests.helpers.configs import ROOT, TINY
from tests.helpers.processes import call

posix = pytest.mark.skipif(os.name == "nt", reason="sends POSIX signals")


@pytest.fixture
def small(tiny_scene: Path, tmp_path: Path) -> list[str]:
    budget = ["hash=C7", "train.rays=8", "train.eval_every=0", "train.log_every=1", "device=cpu", "field=classical"]
    return [
        *TINY,
        *budget,
        "visibility.resolution=16",
        "scene=nerfstudio",
        f"scene.path={tiny_scene}",
        f"store={tmp_path / 'runs'}",
    ]


@pytest.fixture
def parallel(small: list[str], tmp_path: Path) -> Callable[..., subprocess.Popen]:
    """Starts a sweep of two jobs at a time, in a process group of its own."""
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason='needs pip install "qnerf[parallel]"')

    def start(*overrides: str) -> subprocess.Popen:
        launcher = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
        environment = {key: value for key, value in os.environ.items() if key != "OMP_NUM_THREADS"}
        return subprocess.Popen(
            [sys.executable, "-m", "src.run", "-m", *launcher, *small, *overrides],
            cwd=ROOT, env=environment, start_new_session=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    return start


def wait(ready: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 100
    while not ready():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def states(store: Path) -> list[str]:
    return sorted(state(path) for path in runs(store))


def steps(path: Path) -> list[int]:
    return read_metrics(path).query("key == 'train/loss'")["step"].tolist()


def test_jobs_side_by_side_share_the_cores_and_a_failure_stops_none(parallel, tmp_path):
    process = parallel("train.steps=2", "train.lr=1e-2,-1,1e-3")
    stdout, stderr = process.communicate(timeout=200)
    assert process.returncode == 1, stderr
    assert states(tmp_path / "runs") == ["finished"] * 2
    assert "1 failed" in stderr
    assert "train.lr=-1" in stderr
    assert "train.lr must be between 1e-30 and 1000000.0, got -1" in " ".join(stderr.split())
    assert "Traceback" not in stderr
    assert {line.split(" | ")[0] for line in stdout.splitlines()} == {"0", "1", "2"}, "each line says whose it is"
    assert "1 | error: train.lr" in stderr
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    for path in runs(tmp_path / "runs"):
        environment = pd.read_json(path / "environment.json", typ="series")
        assert environment["threads"]["torch"] == max(cores // 2, 1)


@posix
def test_a_killed_sweep_does_only_what_is_missing(parallel, tmp_path):
    store = tmp_path / "runs"
    sweep = ("train.steps=3,200", "seed=0,1")
    process = parallel(*sweep)
    wait(lambda: states(store).count("finished") == 2 and "running" in states(store))
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    finished = {
        path: (path / "summary.parquet").stat().st_mtime_ns for path in runs(store) if state(path) == "finished"
    }
    assert len(finished) == 2
    again = parallel(*sweep)
    stdout, stderr = again.communicate(timeout=200)
    assert again.returncode == 0, stderr
    assert states(store) == ["finished"] * 4
    assert " ".join(stdout.replace("|", " ").split()).count("does it over") == 2
    for path, written in finished.items():
        assert (path / "summary.parquet").stat().st_mtime_ns == written
        assert not (path / "environment-2.json").exists()
    assert sorted(len(steps(path)) for path in runs(store)) == [3, 3, 200, 200]
    assert all(steps(path) == list(range(1, len(steps(path)) + 1)) for path in runs(store))


@posix
@pytest.mark.usefixtures("signals")
@pytest.mark.parametrize("how", ["Ctrl-C in a terminal, which reaches everybody", "SIGHUP to the first process alone"])
def test_a_signal_stops_all_jobs_with_checkpoints(parallel, tmp_path, how):
    store = tmp_path / "runs"
    process = parallel("train.steps=100000", "seed=0,1,2")
    wait(lambda: sum((path / "environment.json").exists() for path in runs(store)) == 2)
    if "everybody" in how:
        os.killpg(process.pid, signal.SIGINT)
    else:
        process.send_signal(signal.SIGHUP)
    stdout, stderr = process.communicate(timeout=100)
    assert process.returncode == 130, stderr
    assert "Traceback" not in stdout + stderr
    assert stderr.strip().splitlines()[-1] == "stopped; the same command continues from the last checkpoints"
    assert states(store) == ["interrupted"] * 2, "the third job was not begun"
    assert all((path / "checkpoint.pt").exists() for path in runs(store))


@posix
def test_jobs_stop_with_checkpoints_when_the_process_that_started_them_is_killed(parallel, tmp_path):
    store = tmp_path / "runs"
    process = parallel("train.steps=100000", "seed=0,1,2")
    wait(lambda: sum((path / "environment.json").exists() for path in runs(store)) == 2)
    process.kill()
    process.communicate(timeout=100)  # returns when no job holds the pipe any more
    assert states(store) == ["interrupted"] * 2
    assert all((path / "checkpoint.pt").exists() for path in runs(store))


def test_a_launcher_without_its_plugin_is_one_line(monkeypatch, capsys):
    monkeypatch.setattr(launch.importlib.util, "find_spec", lambda name: None)
    for name, extra in (("joblib", "parallel"), ("submitit_slurm", "slurm")):
        with pytest.raises(SystemExit) as stop:
            _require(name)
        assert stop.value.code == 2
        assert capsys.readouterr().err == (
            f'error: hydra/launcher={name} needs a plugin: pip install "qnerf[{extra}]"\n'
        )
    _require("basic")


def test_failures_come_in_the_order_of_the_jobs_without_what_all_have_in_common(tmp_path):
    sweep = Sweep(tmp_path / "sweep", ["field=qcolor", "seed=0,1"])
    assert sweep.failures() == []
    for job in (10, 2):
        Sweep(tmp_path / "sweep").fail(job, ["field=qcolor", f"seed={job}"], f"reason {job}")
    assert sweep.failures() == [("seed=2", "reason 2"), ("seed=10", "reason 10")]
    assert not sweep.stopping()
    sweep.stop()
    assert Sweep(tmp_path / "sweep").stopping()


def test_a_damaged_report_of_a_job_is_one_failure(tmp_path):
    sweep = Sweep(tmp_path / "sweep")
    for job in range(4):
        sweep.fail(job, [f"seed={job}"], "reason")
    (sweep.folder / "failed" / "0.json").write_text("[" * 100_000)
    (sweep.folder / "failed" / "1.json").write_text('{"overrides": 3}')
    (sweep.folder / "failed" / "2.json").unlink()
    (sweep.folder / "failed" / "2.json").symlink_to(sweep.folder / "failed" / "3.json")
    (sweep.folder / "failed" / "other.json").write_text("{}")
    failures = sweep.failures()
    assert [job for job, _ in failures] == ["job 0", "job 1", "job 2", "seed=3"]
    assert all("cannot be read" in reason for _, reason in failures[:3])


def test_every_line_gets_its_prefix():
    file = io.StringIO()
    prefixed = _Prefixed(file, "3 | ")
    prefixed.write("one\ntwo\n")
    assert file.getvalue() == "3 | one\n3 | two\n"


@posix
def test_a_schedulers_warning_reaches_its_handler_when_the_run_has_stopped():
    heard: list[str] = []
    previous = signal.signal(signal.SIGUSR2, lambda *_: heard.append("handler"))
    try:
        with stop_requests() as stops:
            signal.raise_signal(signal.SIGUSR2)
            assert stops == [signal.SIGUSR2]
            heard.append("stopped")
        assert heard == ["stopped", "handler"]
    finally:
        signal.signal(signal.SIGUSR2, previous)


@pytest.mark.parametrize(("restarts", "calls"), [(None, 1), ("1", 3)])
def test_a_restarted_job_waits_for_the_heartbeat_of_the_one_that_died(monkeypatch, tmp_path, config, restarts, calls):
    summary = {"eval_views": 1, "psnr": 20.0, "ssim": 0.5, "params.total": 10, "train_s": 1.0, "step_ms": 1.0}
    outcomes = [Outcome("run", tmp_path, state, summary, "") for state in ("busy", "busy", "finished")]
    done: list[Outcome] = []
    monkeypatch.setattr(experiment, "run", lambda *_, **__: done.append(outcomes[len(done)]) or done[-1])
    monkeypatch.setattr(launch, "RETRY", 0.0)
    runtime = SimpleNamespace(choices={"hydra/sweeper": "basic"})
    job = SimpleNamespace(overrides=SimpleNamespace(task=[]), runtime=runtime)
    monkeypatch.setattr(launch.HydraConfig, "get", lambda: job)
    monkeypatch.delenv("SLURM_RESTART_COUNT", raising=False)
    if restarts:
        monkeypatch.setenv("SLURM_RESTART_COUNT", restarts)
    launch._train(launch.OmegaConf.create(config()), "", Sweep(tmp_path))
    assert len(done) == calls


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("encoder=fourier", "encoder=fourier: unknown; known: hash, none, pe, rff"),
        ("encoder.band=3", "unknown option encoder.band; known: bands, frequency_window, include_input"),
        ("color.mlp.wide=3", "unknown option color.mlp.wide; known: init, layers, width"),
    ],
)
def test_an_unknown_choice_or_option_is_one_line(override, message):
    done = call("run", "encoder=pe", override)
    assert done.returncode == 1
    assert done.stderr.startswith(f"error: {message}")
    assert done.stderr.count("\n") == 1
