"""How trainings end: signals, a reader that goes away, a terminal that closes. Through the real command line."""

import contextlib
import functools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from qnerf import experiment
from qnerf.cli import launch, main
from qnerf.cli.ends import Output, output_lost, stoppable
from qnerf.records import Run, read_metrics, runs, state
from qnerf.training.stop_requests import stop_requests
from tests.helpers.configs import ROOT, TINY
from tests.helpers.processes import Forked
from tests.helpers.scenes import write_scene

pytestmark = [
    pytest.mark.skipif(os.name == "nt", reason="sends POSIX signals"),
    pytest.mark.usefixtures("signals"),
]
ENDLESS = "train.steps=100000"


@pytest.fixture
def store(tmp_path: Path) -> Path:
    return tmp_path / "runs"


@pytest.fixture
def options(tmp_path: Path, store: Path) -> list[str]:
    scene = ["scene=nerfstudio", f"scene.path={write_scene(tmp_path / 'scene')}", f"store={store}"]
    budget = ["train.rays=8", "train.eval_every=0", "train.log_every=1", "visibility.resolution=16"]
    return [*TINY, *scene, *budget, "hash=C7", "device=cpu", "threads=1", "field=classical"]


@pytest.fixture
def start() -> Iterator[Callable[..., Forked]]:
    """Starts `qnerf run`."""
    started: list[Forked] = []

    def call(*arguments: str, **options: Any) -> Forked:
        started.append(Forked("run", *arguments, **options))
        return started[-1]

    yield call
    for process in started:
        process.close()


@pytest.fixture
def start_anew() -> Iterator[Callable[..., "subprocess.Popen[str]"]]:
    """Starts `python -m src.run` in a new interpreter, in a process group of its own."""
    started: list[subprocess.Popen[str]] = []

    def call(*arguments: str, **options: Any) -> "subprocess.Popen[str]":
        options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | options
        command = [sys.executable, "-m", "src.run", *arguments]
        started.append(subprocess.Popen(command, cwd=ROOT, start_new_session=True, text=True, **options))
        return started[-1]

    yield call
    for process in started:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        with process:
            pass  # closes its pipes


def wait(ready: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 200
    while not ready():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def training(store: Path, jobs: int = 1) -> Callable[[], bool]:
    """Whether so many runs have logged a step."""
    return lambda: sum(len(read_metrics(run)) > 0 for run in runs(store)) == jobs


def assert_stopped(store: Path, jobs: int = 1) -> None:
    assert [state(run) for run in runs(store)] == ["interrupted"] * jobs
    for run in runs(store):
        assert (run / "checkpoint.pt").is_file()
        assert not list(run.rglob(".*.tmp"))


@pytest.mark.parametrize("how", ["SIGHUP", "SIGTERM and SIGHUP twice", "stdout", "stderr"])
def test_a_training_ends_with_a_checkpoint(start: Any, options: list[str], store: Path, how: str) -> None:
    process = start(*options, ENDLESS)
    wait(training(store))
    closed = {"stdout": process.stdout, "stderr": process.stderr}.get(how)
    if closed is not None:
        closed.close()
    else:
        if "SIGTERM" in how:
            process.send_signal(signal.SIGTERM)
        for _ in range(2 if "twice" in how else 1):
            process.send_signal(signal.SIGHUP)
            time.sleep(0.005)
    errors = process.stderr.read() if how != "stderr" else "the same command continues from there\n"
    process.wait(timeout=100)
    assert process.returncode == (130 if closed is None else 141)
    assert errors.endswith("the same command continues from there\n")
    assert errors.count("\n") == 1
    assert_stopped(store)


def test_a_terminal_that_closes_ends_the_training(options: list[str], store: Path) -> None:
    pid, terminal = os.forkpty()
    if pid == 0:
        os.chdir(ROOT)
        os.execv(sys.executable, [sys.executable, "-m", "src.run", *options, ENDLESS])
    os.set_blocking(terminal, False)

    def read_and_look() -> bool:
        with contextlib.suppress(BlockingIOError):
            os.read(terminal, 2**16)
        return training(store)()

    wait(read_and_look)
    os.close(terminal)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) in (130, 141)
    assert_stopped(store)


def test_nohup_outlives_the_hangup(start: Any, options: list[str], store: Path) -> None:
    process = start(*options, "train.steps=200", before=functools.partial(signal.signal, signal.SIGHUP, signal.SIG_IGN))
    wait(training(store))
    process.send_signal(signal.SIGHUP)
    _, errors = process.communicate(timeout=200)
    assert process.returncode == 0, errors
    assert [state(run) for run in runs(store)] == ["finished"]


def test_a_command_without_standard_streams_writes_into_no_file(
    start_anew: Any, options: list[str], store: Path
) -> None:
    def close() -> None:
        for number in range(3):
            os.close(number)

    process = start_anew(*options, "train.steps=2", stdout=None, stderr=None, preexec_fn=close)
    assert process.wait(timeout=200) == 0
    assert [state(run) for run in runs(store)] == ["finished"]


def test_a_sweep_ends_with_a_checkpoint_once_nobody_reads_its_output(
    start: Any, options: list[str], store: Path
) -> None:
    process = start("-m", *options, ENDLESS, "seed=0,1,2")
    wait(training(store))
    process.stdout.close()
    errors = process.stderr.read()
    assert process.wait(timeout=100) == 141, errors
    assert "the same command continues from" in errors
    assert "Traceback" not in errors
    assert_stopped(store)


def test_too_little_memory_is_one_line(start_anew: Any, options: list[str], store: Path) -> None:
    resource = pytest.importorskip("resource")
    limit = 2**30  # bytes of address space: less than the libraries take

    process = start_anew(*options, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)))
    _, errors = process.communicate(timeout=200)
    assert process.returncode == 2
    assert errors.startswith("error: a limit of this system is reached")
    assert errors.count("\n") == 1


def test_a_stop_while_the_scene_is_read_leaves_no_run(start: Any, options: list[str], tmp_path: Path) -> None:
    (tmp_path / "slow_scene.py").write_text(
        "import signal\n"
        "from qnerf.scenes import SCENES\n\n"
        '@SCENES.register("slow")\n'
        "def slow(*, width: int | None = None):\n"
        "    signal.raise_signal(signal.SIGTERM)\n"
    )
    process = start("plugins=[slow_scene]", *options, "scene.name=slow", "~scene.path", "~scene.downscale",
                    "~scene.skip_missing", env={"PYTHONPATH": str(tmp_path)})  # fmt: skip
    _, errors = process.communicate(timeout=200)
    assert (process.returncode, errors.count("\n")) == (130, 1), errors
    assert errors.startswith("stopped; the same command continues")
    assert not (tmp_path / "runs").exists()


def test_a_stop_while_modules_are_imported_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(launch, "run_command", interrupted)
    monkeypatch.setattr(sys, "argv", ["qnerf run"])
    with pytest.raises(SystemExit) as end:
        main.run()
    assert end.value.code == 130
    assert capsys.readouterr().err == "stopped\n"


def test_a_run_that_is_being_finished_is_finished(tiny: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first request comes too late to matter; the second interrupts the run, which then can be resumed."""
    finish, requests = Run.finish, 2

    def stopped(self: Run, summary: Any = None) -> None:
        for _ in range(requests):
            signal.raise_signal(signal.SIGTERM)
        finish(self, summary)

    monkeypatch.setattr(Run, "finish", stopped)
    with stoppable(), pytest.raises(KeyboardInterrupt):
        experiment.run(tiny())
    assert [state(run) for run in runs(tiny()["store"])] == ["interrupted"]
    requests = 1
    with stoppable():
        assert experiment.run(tiny()).state == "finished"


# The pieces


def test_the_rest_is_dropped_once_the_reader_is_gone() -> None:
    reading, writing = os.pipe()
    with open(writing, "w") as stream:
        output = Output(stream, watched=True)
        output.write("one\n")
        assert not output.is_lost()
        os.close(reading)
        assert output.is_lost()
        output.write("two\n" * 100_000)
        output.flush()


def test_a_full_disk_loses_the_output_and_raises_nothing() -> None:
    if not os.path.exists("/dev/full"):
        pytest.skip("there is no /dev/full here")
    with open("/dev/full", "w") as stream:
        output = Output(stream, watched=True)
        assert not output.is_lost()
        output.write("one\n")
        output.flush()
        assert output.is_lost()


def test_the_streams_and_handlers_are_restored() -> None:
    before = sys.stdout, sys.stderr, signal.getsignal(signal.SIGTERM)
    with stoppable(), stoppable():
        assert isinstance(sys.stdout, Output)
        assert not output_lost()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
    assert (sys.stdout, sys.stderr, signal.getsignal(signal.SIGTERM)) == before


def test_a_second_request_of_either_kind_acts_as_usual() -> None:
    with stop_requests() as stops:
        for _ in range(3):
            signal.raise_signal(signal.SIGHUP)
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert stops == [signal.SIGHUP] * 3 + [signal.SIGTERM]


def test_an_ignored_hangup_stays_ignored() -> None:
    previous = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stoppable(), stop_requests() as stops:
            signal.raise_signal(signal.SIGHUP)
        assert stops == []
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, previous)
