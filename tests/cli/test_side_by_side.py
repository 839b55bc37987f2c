"""`hydra/launcher=side_by_side`: the jobs of a sweep in one process."""

from typing import Any

from qnerf import experiment
from qnerf.cli.training import train_beside
from qnerf.records import read_summary, runs
from tests.helpers.stopping import StopsWhen


def test_jobs_that_fail_or_are_the_same_run_stop_none(qnerf: Any, small: Any, tmp_path: Any) -> None:
    options = ["train.steps=2", "seed=0,1", "qfgn.scale=1,2", "density.initial=0.1,-1", "hydra/launcher=side_by_side"]
    done = qnerf("run", "-m", *small, *options)
    assert done.out.startswith("8 jobs, ")
    assert done.code == 1
    assert "4 failed" in done.err
    assert done.out.count("finished already") == 2
    found = [read_summary(path) for path in runs(tmp_path / "runs")]
    assert sorted((row["seed"], row["state"], row["time.beside"]) for row in found) == [
        (0, "finished", 2), (1, "finished", 2)
    ]  # fmt: skip
    assert "seed=1 qfgn.scale=1 density.initial=0.1: step 2/2" in done.out


def test_a_batch_has_as_many_as_are_wanted(qnerf: Any, small: Any, tmp_path: Any) -> None:
    wanted = ["hydra/launcher=side_by_side", "hydra.launcher.runs=2"]
    assert qnerf("run", "-m", *small, "train.steps=1", "seed=0,1,2", *wanted).code == 0
    assert sorted(read_summary(path)["time.beside"] for path in runs(tmp_path / "runs")) == [1, 2, 2]
    refused = qnerf("run", "-m", *small, "seed=0,1", "hydra/launcher=side_by_side", "hydra.launcher.runs=0")
    assert refused.code == 2
    assert "hydra.launcher.runs" in refused.err


def test_after_a_stop_nothing_else_begins(tiny: Any, tmp_path: Any) -> None:
    from qnerf.building.configuration import Configuration

    asked = [Configuration.of(tiny("train.steps=4", f"seed={seed}", f"store={tmp_path}")) for seed in (0, 0, 1)]
    steps = iter(range(5))
    displays = [StopsWhen(lambda: next(steps, 5) > 2), *(experiment.Display() for _ in asked[1:])]
    ended = train_beside([(one, (), display) for one, display in zip(asked, displays, strict=True)])
    states = [(number, outcome.state) for number, outcome in ended if isinstance(outcome, experiment.Outcome)]
    assert states == [(2, "finished"), (0, "interrupted")]
