"""The command line as a user meets it."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

from qnerf import records
from qnerf.cli.main import main
from tests.helpers import processes
from tests.helpers.configs import TINY

SMALL = [
    *TINY,
    "hash=C7",
    "train.rays=8",
    "train.eval_every=0",
    "train.log_every=1",
    "device=cpu",
    "visibility.resolution=16",
]


def call(*arguments: str) -> subprocess.CompletedProcess:
    return processes.call("run", *arguments)


@pytest.fixture
def small(tiny_scene: Path, tmp_path: Path) -> list[str]:
    return [*SMALL, "scene=nerfstudio", f"scene.path={tiny_scene}", f"store={tmp_path / 'runs'}"]


def runs(small: list[str]) -> list[Path]:
    store = Path(next(item for item in small if item.startswith("store=")).removeprefix("store="))
    return sorted(path for path in store.glob("*") if not path.name.startswith("."))


def test_a_run_shows_the_configuration_and_a_closing_table(small):
    done = call(*small, "train.steps=3")
    assert done.returncode == 0, done.stderr
    assert "├── seed: 0" in done.stdout
    for word in ("PSNR", "SSIM", "parameters", "encoder", "training", runs(small)[0].name):
        assert word in done.stdout


def test_a_sweep_runs_every_job_and_one_failure_does_not_stop_the_others(small):
    done = call("-m", *small, "train.steps=2", "field=qcolor", "qiren.layers=1,0,2", "qiren.qubits=3")
    assert done.returncode == 1
    assert "1 failed" in done.stderr
    assert "layers must be between 1 and 64, got 0" in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr
    summaries = pd.concat([pd.read_parquet(path / "summary.parquet") for path in runs(small)])
    assert sorted(summaries["qiren"]) == ["1L2S", "2L2S"]
    assert set(summaries["state"]) == {"finished"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train.steps=-1"], "error: train.steps must be between 1 and 1000000000, got -1"),
        (["qiren.qubits=4000"], "error: "),
        (["scene=nerfstudio"], "error: scene.path must be given"),
        (["scene=nerfstudio", "scene.path=/nowhere"], "/nowhere"),
        (["field=quantum"], "field=quantum: unknown; known: classical"),
        (["qiren.depth=3"], "unknown option qiren.depth; known: ansatz"),
    ],
)
def test_a_mistake_is_told_without_a_traceback(tmp_path, arguments, message):
    done = call(*arguments, f"store={tmp_path / 'runs'}")
    assert done.returncode != 0
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "runs").exists()


def test_help_lists_groups_and_choices():
    done = call("--help")
    assert done.returncode == 0
    assert "field: classical, qboth, qcolor, qdensity" in done.stdout
    assert "1L1S" in done.stdout


def test_cfg_job_prints_the_configuration(small):
    done = call(*small, "--cfg", "job")
    assert done.returncode == 0
    assert "log2_table_size: 13" in done.stdout


def test_the_console_command_takes_the_same_options(small, tmp_path):
    """Also where standard output knows only ASCII, and the store is named with an umlaut."""
    store = tmp_path / "täst"
    done = subprocess.run(
        [sys.executable, "-m", "qnerf", "run", *small, "train.steps=2", f"store='{store}'"],
        env=os.environ | {"PYTHONIOENCODING": "ascii", "LC_ALL": "C"},
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    (run,) = records.runs(store)
    assert f"t\\xe4st/{run.name}" in done.stdout
    unknown = processes.call("fly")
    assert unknown.returncode == 2
    assert "known: run" in unknown.stderr


@pytest.mark.skipif(os.name == "nt", reason="sends POSIX signals")
@pytest.mark.usefixtures("signals")
def test_ctrl_c_stops_with_a_checkpoint_and_the_same_command_goes_on(small):
    arguments = [*small, "train.steps=200"]
    process = processes.Forked("run", *arguments)
    deadline = time.monotonic() + 60
    while not any((path / "environment.json").exists() for path in runs(small)) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=60)
    process.close()
    assert process.returncode == 130, stderr
    assert "the same command continues from" in " ".join((stdout + stderr).split())
    assert "Traceback" not in stderr
    (folder,) = runs(small)
    assert pd.read_parquet(folder / "summary.parquet").iloc[0]["state"] == "interrupted"
    again = call(*arguments)
    assert again.returncode == 0, again.stderr
    steps = pd.read_parquet(folder / "metrics").query("key == 'train/loss'")["step"]
    assert steps.tolist() == list(range(1, 201))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "arguments are required: RUN"),
        (["/nowhere"], "/nowhere: no such run"),
        (["/nowhere", "shot=3"], "unknown option 'shot'; known: shots, noise, p, views, seed"),
        (["/nowhere", "shots=many"], "shots expects numbers with commas between them, got 'many'"),
    ],
)
def test_probe_tells_a_mistake_in_one_line(monkeypatch, capsys, tmp_path, arguments, message):
    if "shot" in message:
        (tmp_path / "a-run").mkdir()
        arguments = [str(tmp_path / "a-run"), *arguments[1:]]
        (tmp_path / "a-run" / "status.json").write_text("{}")
    monkeypatch.setattr(sys, "argv", ["qnerf", "probe", *arguments])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


def test_a_misspelt_command_is_answered_with_the_nearest(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["qnerf", "tabels"])
    with pytest.raises(SystemExit, match="2"):
        main()
    assert "unknown command 'tabels'; did you mean tables? known: run, " in capsys.readouterr().err
