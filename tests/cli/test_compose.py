"""What is typed wrongly is one line with the cure, exit code 2, and nothing is written."""

import re
import shlex
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import hydra
import pytest
from hydra import version
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.singleton import Singleton
from hydra.core.utils import JobRuntime

from qnerf import experiment
from qnerf.cli.compose import arguments_for_hydra, configuration, expand_sweep, parse
from qnerf.cli.errors import one_line
from qnerf.cli.sweep import combinations
from qnerf.config.folders import SWEEPS

MISTAKES = {
    "=1": "'=1': expected OPTION=VALUE",
    "~": "'~': expected OPTION=VALUE",
    "seed": "'seed': expected OPTION=VALUE; did you mean seed=...?",
    "seed=0 --nope": "unrecognized arguments: --nope",
    "--steps 100": "an option is set by OPTION=VALUE; did you mean train.steps=...?",
    "-cn": "argument --config-name/-cn: expected one argument",
    "qiren.layers=1, 2, 3": "have commas between them and no spaces, such as qiren.layers=1,2,3",
    "qiren.layers=1,2": "several values are a sweep, add -m",
    "seed=range(0,2)": "seed=range(0,2): several values are a sweep, add -m",
    "hydra/sweeper=qnerf_optuna hydra.sweeper.n_trial=3": "sweeper.n_trial; did you mean hydra.sweeper.n_trials=...?",
    "sed=1,2": "unknown option sed; did you mean seed=...?",
    "lr=0.1": "unknown option lr; did you mean train.lr=...?",
    "rays=3": "unknown option rays; did you mean stop.rays=... or train.rays=...?",
    "qiren.layer=2": "unknown option qiren.layer; did you mean qiren.layers=...?",
    "encoder=pe encoder.wide=3": "unknown option encoder.wide; known: bands, ",
    "head=mlp": "unknown option head; known: ansatz, ",
    "encoder=fourier": "encoder=fourier: unknown; known: hash, none, pe, rff",
    "density=QIREN": "density=QIREN: unknown; did you mean qiren?",
    "field=qcolour": "field=qcolour: unknown; did you mean qcolor? known: classical",
    "hash=null": "Config group override must be a string or a list",
    "hash=???": "You must specify 'hash'",
    "seed=${nope}": "Interpolation key 'nope' not found",
    "scene=nerfstudio": "scene.path must be given",
    "plugins=[..my_module]": "plugins: expected names of modules such as my_module or package.module",
    "seed=[1": "seed=[1: cannot be read; close its brackets, or quote ",
    "-m store= seed=1,2": "store must not be empty",
    "-m seed=range(0,0)": "seed=range(0,0): an empty list of values, so there is no job",
    "-m seed=range(0,1000000000000)": "more than 100000 jobs",
    "-m seed=0,1 hash=C1,nope": "hash=nope: unknown; known: C1, C2",
    "-m ansatz=qiren,rx qiren.ansatz_options.qiren.ranges=[1]": "unknown option qiren.ansatz_options.qiren.ranges",
    "--sweep sedes": "got 'sedes'; did you mean seeds? known: ansatz, ",
    "--sweep": "--sweep expects a .yaml file or a known sweep, got ''",
}


def test_a_wrong_command_is_one_line_with_exit_code_2(qnerf):
    for line, message in MISTAKES.items():
        done = qnerf("run", *line.split(" "))
        assert (done.code, done.err.count("\n")) == (2, 1), (line, done)
        assert done.err.startswith("error: "), line
        assert message in done.err, (line, done.err)
        unknown = re.search(r"unknown option (\S+); known: (.*)", done.err)
        assert unknown is None or unknown[1].rpartition(".")[2] not in unknown[2].split(", "), "it lists itself"
    assert not list(Path().iterdir())


def test_the_cure_of_what_cannot_be_read_can_be_typed():
    for typed in ("store=~/runs", "scene.path=/data/epoch=1", "store=/täst", "store=/d (2)/x", "store=a{b"):
        with pytest.raises(ValueError, match="cannot be read; ") as error:
            arguments_for_hydra([typed])
        (cure,) = shlex.split(str(error.value).partition("for Hydra: ")[2])
        assert OverridesParser.create().parse_override(cure).value() == typed.partition("=")[2]


def test_brackets_without_end_are_one_line():
    with pytest.raises(ValueError, match="cannot be read"):
        arguments_for_hydra(["needs=" + 2000 * "["])


def test_sweeps_are_files_that_hydra_finds(tmp_path):
    for file in [*SWEEPS.glob("*.yaml"), tmp_path / "mine.yaml"]:
        name = file.stem if file.parent == SWEEPS else str(file)
        if file.parent != SWEEPS:
            file.write_text("defaults: [config, _self_]\n")
        expected = ["-cd", str(file.parent), "-cn", file.stem, "budget=short"]
        assert expand_sweep(["--sweep", name, "budget=short"]) == expected
        assert expand_sweep([f"--sweep={name}", "budget=short"]) == expected


@pytest.mark.parametrize("text", ["", "seed: 1", "defaults: []", "- 1", "a: [", "defaults:\n  - nothing"])
def test_a_file_that_is_no_sweep_is_one_line(tmp_path, text):
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(ValueError, match=r"^--sweep .*mine\.yaml: (expected `defaults|cannot be read)") as caught:
        expand_sweep(["--sweep", str(tmp_path / "mine.yaml")])
    assert "\n" not in one_line(caught.value)


def test_a_bug_and_errors_that_are_wanted_in_full_keep_their_traceback(qnerf, monkeypatch):
    monkeypatch.setattr(experiment, "run", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        qnerf("run", "device=cpu")
    with pytest.raises(ValueError, match="seed"):
        qnerf("run", "seed=-1", full_error=True)
    with pytest.raises(Exception, match="Could not override"):
        qnerf("run", "qiren.depth=3", full_error=True)


TWICE = {
    "color.mlp={layers:2} color.mlp={width:16} seed=0,1": [
        "color.mlp={layers:2} color.mlp={width:16} seed=0",
        "color.mlp={layers:2} color.mlp={width:16} seed=1",
    ],
    "a={b:2},{b:3} a={c:8},{c:9}": ["a={b:2} a={c:8}", "a={b:2} a={c:9}", "a={b:3} a={c:8}", "a={b:3} a={c:9}"],
    "seed=0,1 seed=2": ["seed=2"],
    "seed=2 seed=range(0,2)": ["seed=0", "seed=1"],
    "a={b:3} a=1 a={c:2}": ["a=1 a={c:2}"],
    "hash=glob(C*) seed=0 hash=glob(C6)": ["seed=0 hash=C6"],
    "+x=1 +x=2": ["+x=2"],
}
"""What is typed -> its jobs: of an option given twice the last holds as in a single run, where mappings are merged."""


@pytest.mark.parametrize("typed", TWICE)
def test_jobs_are_what_single_commands_compose(typed):
    jobs = combinations([parse(override) for override in typed.split()])
    assert [" ".join(job) for job in jobs] == TWICE[typed]


def test_composing_leaves_the_callers_hydra_alone(tmp_path):
    (tmp_path / "own.yaml").write_text("lr: 0.1")
    before = Singleton.get_state()
    with hydra.initialize_config_dir(str(tmp_path), job_name="mine", version_base="1.2"):
        base = version.getbase()
        assert configuration(["seed=3"])["seed"] == 3
        with pytest.raises(ValueError, match="unknown option sed"):
            configuration(["sed=3"])
        assert hydra.compose("own") == {"lr": 0.1}
        assert (version.getbase(), JobRuntime().get("name")) == (base, "mine")
    Singleton.set_state(before)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda seed: configuration([f"seed={seed}"])["seed"], range(8)))
    assert found == list(range(8))
