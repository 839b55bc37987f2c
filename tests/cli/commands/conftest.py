"""A store with a run of every kind, and the commands called as the command line calls them."""

import numpy as np
import pytest

from qnerf.cli import main
from qnerf.records import RunStore
from tests.cli.conftest import Done

ENVIRONMENT = {
    "git": {"commit": "c0ffee", "branch": "main", "dirty": False},
    "packages": {"torch": "2.13.0", "numpy": "2.4.6"},
    "python": "3.11.7",
    "host": "here",
    "cpu": {"model": "EPYC", "usable": 2},
    "gpu": {"names": []},
    "threads": {"torch": 1},
    "command": ["src/run.py", "seed=0"],
}


def config(seed=0, lr=0.01):
    return {
        "seed": seed,
        "threads": 1,
        "train": {"steps": 40, "lr": lr, "samples": [8, 6]},
        "scene": {"name": "poster", "path": None},
    }


def write(run, steps=40, psnr=20.0):
    """Rows every tenth step; at the end an evaluation, an environment and a picture."""
    for step in range(10, steps + 1, 10):
        run.log(step, step / 10, {"train/loss": 1 / step, "train/psnr": 10 + step / 4})
    run.write_environment(ENVIRONMENT)
    run.write_eval([{"image": f"view{i}.png", "psnr": psnr + i, "ssim": 0.5} for i in range(2)])
    run.write_summary({"params.total": 1234, "params.density": 200, "params.color": 34, "time.field_ms": 1.5})
    run.save_image("view0", np.zeros((2, 3, 3), np.uint8))


@pytest.fixture
def make(tmp_path, monkeypatch):
    """`make("a-s0-1", end="finish", psnr=20.0, field="qcolor", seed=1)`: a run's folder."""
    monkeypatch.setattr("os.fsync", lambda _: None)  # no test here cuts the power
    store = RunStore(tmp_path / "runs", every=60)

    def made(name, end="finish", psnr=20.0, field="qcolor", **options):
        columns = {
            "field": field,
            "encoder": "hash",
            "color": "3x64" if field == "classical" else "1L2S",
            "scene": "poster",
        }
        claim = store.claim(name, config(**options), ["seed=0", f"field={field}"], columns=columns)
        write(claim.run, 40 if end == "finish" else 20, psnr)
        if end == "finish":
            claim.run.finish({"psnr": psnr, "ssim": 0.5, "train_s": 100.0, "step_ms": 25.0, "steps": 40})
        elif end == "fail":
            claim.run.fail("loss is NaN")
        else:
            claim.run.interrupt()
        return claim.dir

    return made


@pytest.fixture
def store(make, tmp_path):
    make("poster-qcolor-s0-aaaaaaaaaa", psnr=21.5)
    make("poster-classical-s0-bbbbbbbbbb", psnr=23.25, field="classical", lr=0.02)
    make("poster-qcolor-s1-cccccccccc", "fail", seed=1)
    make("poster-qcolor-s2-dddddddddd", "interrupt", seed=2)
    damaged = make("poster-qboth-s0-eeeeeeeeee", field="qboth")
    (damaged / "summary.parquet").write_bytes(b"PAR1 this is no table")
    return tmp_path / "runs"


@pytest.fixture
def running(tmp_path):
    """A run that this process is writing."""
    claim = RunStore(tmp_path / "runs", every=60).claim(
        "live-qcolor-s0-ffffffffff", config(), columns={"field": "qcolor"}
    )
    claim.run.log(10, 1.0, {"train/loss": 0.5, "train/psnr": 12.0})
    claim.run.log(20, 2.0, {"train/loss": 0.25, "train/psnr": 15.0})
    claim.run.flush()
    claim.run._write_status()
    with claim.run as run:
        yield run


@pytest.fixture
def qnerf(capsys, tmp_path):
    """`qnerf("show", "aaaa")`: exit code and output of a command on the store."""

    def call(command, *arguments):
        capsys.readouterr()
        try:
            code = main.dispatch(command, [*map(str, arguments), "--store", str(tmp_path / "runs")])
        except SystemExit as stop:
            code = int(stop.code or 0)
        out, err = capsys.readouterr()
        return Done(code, out, err)

    return call


@pytest.fixture
def terminal(monkeypatch):
    """`terminal(80)`: what follows is printed as on a terminal of that width, without colours."""

    def be(width, height=40):
        for name, value in {"COLUMNS": width, "LINES": height, "FORCE_COLOR": 1, "TERM": "xterm"}.items():
            monkeypatch.setenv(name, str(value))
        monkeypatch.setattr("rich.console.Console._detect_color_system", lambda self: None)

    return be
