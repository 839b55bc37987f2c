"""`hydra/sweeper=qnerf_optuna` as a user meets it."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

pytest.importorskip("optuna", reason='needs pip install "qnerf[search]"')

from qnerf.cli.search import judge, values_of
from qnerf.experiment import run
from qnerf.records import read_summary, runs, state
from qnerf.search.space import Choices, Interval
from tests.helpers.configs import ROOT, TINY

SMALL = [
    *TINY,
    "hash=C7",
    "train.rays=8",
    "train.log_every=1",
    "train.eval_views=1",
    "device=cpu",
    "run.progress=false",
]


def start(store: Path, *overrides: str) -> subprocess.Popen:
    command = [
        sys.executable,
        "-m",
        "src.run",
        "-m",
        "hydra/sweeper=qnerf_optuna",
        *SMALL,
        f"store={store}",
        *overrides,
    ]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, cwd=ROOT, start_new_session=True, text=True, **pipes)  # type: ignore[call-overload]


@pytest.mark.skipif(os.name == "nt", reason="sends POSIX signals")
def test_a_search_killed_by_the_system_goes_on_prunes_and_ends_with_a_table(tiny_scene, tmp_path):
    store = tmp_path / "runs"
    search = (
        "hydra.sweeper.n_trials=4", "hydra.sweeper.startup=5", "hydra.sweeper.prune={least: 2, percentile: 99}",
        "train.steps=10", "train.eval_every=5", "scene=nerfstudio", f"scene.path={tiny_scene}", "field=classical",
        "train.lr=tag(log,interval(1e-4,1e-1))",
    )  # fmt: skip
    process = start(store, *search)
    deadline = time.monotonic() + 200
    while len(runs(store)) < 3:
        assert time.monotonic() < deadline
        assert process.poll() is None, process.stderr and process.stderr.read()
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    before = {path: (path / "summary.parquet").stat() for path in runs(store) if state(path) == "finished"}
    stdout, stderr = (again := start(store, *search)).communicate(timeout=300)
    assert again.returncode == 0, stderr
    assert len(runs(store)) == 4
    assert {path: (path / "summary.parquet").stat() for path in before} == before
    ends = {path: (state(path), read_summary(path).get("stopped")) for path in runs(store)}
    assert set(ends.values()) <= {("finished", None), ("interrupted", "pruned")}
    pruned = sum(end[1] == "pruned" for end in ends.values())
    assert pruned, "the third is between the first two, and only the best of them counts"
    closing = stdout.rpartition("\n\n")[2]
    assert closing.startswith(f"best {4 - pruned} of 4 trials (")
    assert f"{pruned} pruned" in closing
    assert closing.count("train.lr=") == 4 - pruned
    assert stdout.count("pruned at step") == pruned


def test_a_pruned_run_is_interrupted_and_anybody_may_continue_it(tiny):
    config = tiny("train.steps=3", "train.eval_every=1", "train.eval_views=1")
    seen: list[int] = []

    def unpromising(path: Path, step: int, measured: dict) -> bool:
        seen.append(step)
        return step == 2

    outcome = run(config, unpromising=unpromising)
    assert (outcome.state, state(outcome.path), outcome.summary["stopped"]) == ("pruned", "interrupted", "pruned")
    assert seen == [1, 2]
    assert outcome.message == "pruned at step 2 of 3: finished runs were better by then"
    again = run(config)
    assert (again.state, again.run_id, again.summary["stopped"]) == ("finished", outcome.run_id, None)


def test_a_sweep_is_no_search(tmp_path):
    assert judge(tmp_path, tmp_path) is None


@pytest.mark.parametrize(
    ("typed", "values"),
    [
        ("a=1,3,2", Choices(("1", "3", "2"), (1, 3, 2))),
        ("a=1,1.0,true", Choices(("1", "True"), (1, True))),
        ("a=range(1,4)", Choices(("1", "2", "3"), (1, 2, 3))),
        ("a=[8,6],null,mlp", Choices(("[8,6]", "null", "mlp"), ([8, 6], None, "mlp"))),
        ("a=interval(0,1)", Interval(0.0, 1.0)),
        ("a=int(interval(1,8))", Interval(1, 8, integer=True)),
        ("a=tag(int,log,interval(1,8))", Interval(1, 8, log=True, integer=True)),
        ("a=tag(log,interval(1e-4,1e-1))", Interval(1e-4, 1e-1, log=True)),
    ],
)
def test_the_space_is_written_as_a_sweep(typed, values):
    assert values_of(OverridesParser.create().parse_override(typed), group=False) == values


@pytest.mark.parametrize("typed", ["a=interval(2,1)", "a=tag(log,interval(0,1))"])
def test_an_interval_that_is_none_is_a_mistake(typed):
    with pytest.raises(ValueError, match="expected two numbers, the smaller one first"):
        values_of(OverridesParser.create().parse_override(typed), group=False)


def test_configurations_that_differ_in_nothing_that_acts_are_tried_once(tiny_scene, tmp_path):
    process = start(
        tmp_path / "runs", "scene=nerfstudio", f"scene.path={tiny_scene}", "train.steps=2",
        "field=classical,qcolor", "qiren.layers=1,2",
    )  # fmt: skip
    stdout, stderr = process.communicate(timeout=300)
    assert process.returncode == 0, stderr
    assert "of 3 trials" in stdout
    assert len(runs(tmp_path / "runs")) == 3
