"""A mistake on the command line is one line, whatever it is, and nothing is written."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hydra.core.global_hydra import GlobalHydra

from qnerf import experiment
from qnerf.cli import launch
from qnerf.cli.launch import run_command

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
        (["steps"], "Error parsing override 'steps' missing EQUAL"),
        (["seed=[1"], "no viable alternative at input '[1'"),
        (["needs=" + 2000 * "["], ""),
        (["plugins=" + 2000 * "["], "expected a list of modules"),
        (["plugins=3"], "plugins=3: expected a list of modules, such as plugins=[my_module]"),
        (["hash=null"], "hash=null: expected the name of a choice; known: C1, C2"),
        (["needs=5"], "needs=5: expected the name of a choice; known: auto, full, none"),
        (["density=null"], "head@density=null: expected the name of a choice; known: mlp, qfgn, qiren"),
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
        (["store=/täst"], "store=/täst: has a character that needs quotes, as in \"store='my runs'\""),
        (["-m", "seed=range(0,1000000000000)"], "the sweep has more than 100000 jobs"),
    ],
)
def test_a_mistake_is_one_line(call, tmp_path, arguments, message):
    text = call(*arguments)
    assert text.startswith("error: ")
    assert message in text
    assert text.count("\n") == 1
    assert not list(tmp_path.iterdir())


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
    monkeypatch.setattr(experiment, "run", lambda *_: 1 / 0)
    with pytest.raises(error):
        call(*arguments)


def test_hydras_full_error_can_be_asked_for(call, monkeypatch):
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(Exception, match="no viable alternative"):
        call("seed=[1")
