"""A mistake on the command line is one line, whatever it is, and nothing is written."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

from qnerf import experiment
from qnerf.cli import launch
from qnerf.cli.launch import run_command
from qnerf.cli.sweep import check_file, expand_sweep
from tests.helpers.configs import ROOT, TINY

BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{after}: &{after} [{', '.join(9 * [f'*{before}'])}]\n" for before, after in zip("abcdef", "bcdefg", strict=True)
)

Call = Callable[..., str]


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path) -> Call:
    """Runs a command in this process, in an empty folder; returns what it writes on standard error."""

    def run(*arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", ["qnerf run", *arguments])
        with pytest.raises(SystemExit) as end:
            run_command()
        assert end.value.code
        return capsys.readouterr().err

    monkeypatch.chdir(tmp_path)
    # Hydra would disable the loggers of all tests.
    monkeypatch.setattr("hydra._internal.logging_config.configure_logging", lambda _: None)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    monkeypatch.setattr(launch, "_started", [])
    monkeypatch.setattr(launch, "_jobs", [])
    GlobalHydra.instance().clear()
    yield run
    GlobalHydra.instance().clear()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["=1"], "'=1': expected OPTION=VALUE"),
        (["~"], "'~': expected OPTION=VALUE"),
        (["seed=0", "--nope"], "error: unrecognized arguments: --nope\n"),
        (["-cn"], "error: argument --config-name/-cn: expected one argument\n"),
        (["store=~/runs"], "store=~/runs: cannot be read; quote a value"),
        (["seed=range(100001)", "-m"], "the sweep has more than 100000 jobs"),
        (
            ["-m", "seed=0,1", "hydra.sweeper.max_batch_size=0"],
            "max_batch_size must be between 1 and 1000000000, got 0",
        ),
        (["steps"], "Error parsing override 'steps' missing EQUAL"),
        (["seed=[1"], "no viable alternative at input '[1'"),
        (["needs=" + 2000 * "["], ""),
        (["plugins=" + 2000 * "["], "expected a list of modules"),
        (["plugins=3"], "plugins=3: expected a list of modules, such as plugins=[my_module]"),
        (["plugins=[..my_module]"], "plugins: expected names of modules such as my_module or package.module"),
        (["plugins=['']"], "plugins: expected names of modules such as my_module or package.module, got ''"),
        (["hash=null"], "hash=null: expected the name of a choice; known: C1, C2"),
        (["needs=5"], "needs=5: expected the name of a choice; known: auto, full, none"),
        (["density=null"], "head@density=null: expected the name of a choice; known: amplitude, bloch, "),
        (["experiment=[qiren]"], "experiment=qiren: unknown"),
        (["hash=???"], "You must specify 'hash'"),
        (["run=null"], "run must be a group of options, got None"),
        (["seed=${nope}"], "seed: Interpolation key 'nope' not found"),
        (["train.rates=[1]"], "train.rates: Cannot merge DictConfig with ListConfig"),
        (["color.qiren=null"], "color.qiren must be a group of options, got None"),
        (["color.name=[qiren]"], "color.name expects str, got ['qiren'] (list)"),
        (["sampler.samples=[8.5,6]"], "sampler.samples[0] expects int, got 8.5 (float)"),
        (["qfgn.features=9223372036854775808"], "qfgn.features must be within 64 bits, got 9223372036854775808"),
        (["threads=100000"], "threads must be between 1 and 1024, got 100000"),
        (["store="], "store must not be empty"),
        (["hydra.verbose=3"], ""),
        (["-m", "store=", "seed=1,2"], "store must not be empty"),
        (["-m", "seed=range(0,0)"], "seed=range(0,0): an empty list of values, so there is no job"),
        (["-m", "seed=range(0,0)", "field=qcolor,classical"], "so there is no job"),
        (["-m", "seed=0,1", "hash=C1,nope"], "hash=nope: unknown; known: C1, C2"),
        (["store=/täst"], "store=/täst: cannot be read; quote a value that holds special characters"),
        (["-m", "seed=range(0,1000000000000)"], "the sweep has more than 100000 jobs"),
    ],
)
def test_a_mistake_is_one_line(call, tmp_path, arguments, message):
    text = call(*arguments)
    assert text.startswith("error: ")
    assert message in text
    assert text.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_matplotlibs_settings_are_checked_before_the_training(tiny_scene, tmp_path):
    small = [*TINY, "scene=nerfstudio", f"scene.path={tiny_scene}", "field=classical", "hash=C7", "train.steps=2"]
    done = subprocess.run(
        [sys.executable, "-m", "src.run", *small, f"store={tmp_path / 'runs'}"],
        cwd=ROOT, env={**os.environ, "MPLBACKEND": "nope"}, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr.startswith("error: Key backend: 'nope' is not a valid value")
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (BOMB, "its aliases stand for more than 10000 values"),
        ("a: &a [*a]\n", "its aliases stand for more than 10000 values"),
        ("#" * 2**18 + "\n", "more than 256 KiB of configuration"),
    ],
)
@pytest.mark.parametrize("chosen", [["--sweep", "mine.yaml"], ["-cd", ".", "-cn", "mine"]])
def test_a_hostile_file_of_a_sweep_is_refused(call, monkeypatch, tmp_path, content, message, chosen):
    file = tmp_path / "mine.yaml"
    file.write_text(content)
    text = call(*expand_sweep(chosen))
    assert text.startswith("error: ")
    assert message in text
    assert text.count("\n") == 1
    assert list(tmp_path.iterdir()) == [file]


def test_a_file_of_a_sweep_may_repeat_itself(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("a: &a {b: [1, 2]}\nc: *a\nd: {<<: *a}\n")
    check_file(file)


def test_joblib_starts_no_more_processes_than_it_has_jobs(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    for wanted, started in ((100_000, 3), (2, 2), (-1, -1)):
        config = OmegaConf.create({"hydra": {"sweeper": {}, "launcher": {"n_jobs": wanted}}})
        launch._limit_processes(config, 3)
        assert config.hydra.launcher.n_jobs == started
    config.hydra.launcher.n_jobs = 0
    with pytest.raises(ValueError, match="n_jobs must be at least 1, or -1"):
        launch._limit_processes(config, 3)


def test_a_plain_run_is_never_abandoned(call, monkeypatch):
    monkeypatch.setenv(launch.STARTER, "1")
    monkeypatch.setattr(experiment, "run", lambda *_, **__: 1 / 0)
    monkeypatch.setattr(os, "_exit", lambda _: pytest.fail("left at once"))
    with pytest.raises(ZeroDivisionError):
        call("device=cpu")


def test_an_environment_variable_is_checked(call, monkeypatch, tmp_path):
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "many")
    assert call() == "error: SLURM_CPUS_PER_TASK must be a whole number, got 'many'\n"
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "100000")
    assert "threads must be between 1 and 1024, got 100000" in call()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("pid", ["", "abc", "²", str(10**30)])
def test_a_job_is_abandoned_only_if_its_starter_is_a_process(monkeypatch, pid):
    monkeypatch.setenv(launch.STARTER, pid)
    assert launch._is_abandoned() is (pid == str(10**30))


@pytest.mark.parametrize(
    ("arguments", "error"), [(["run.debug=true", "seed=-1"], ValueError), (["device=cpu"], ZeroDivisionError)]
)
def test_a_bug_and_what_is_debugged_keep_their_traceback(call, monkeypatch, arguments, error):
    monkeypatch.setattr(experiment, "run", lambda *_, **__: 1 / 0)
    with pytest.raises(error):
        call(*arguments)


def test_hydras_full_error_can_be_asked_for(call, monkeypatch):
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(Exception, match="no viable alternative"):
        call("seed=[1")
