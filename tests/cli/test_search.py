"""`hydra/sweeper=qnerf_optuna` as a user meets it."""

import re

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

pytest.importorskip("optuna", reason='needs pip install "qnerf[search]"')

from qnerf.cli.search import values_of
from qnerf.experiment import Display, run
from qnerf.records import read_summary, runs, state
from qnerf.search.objectives import TUNING
from qnerf.search.space import Choices, Interval

SEARCH = ("-m", "hydra/sweeper=qnerf_optuna", "run.progress=false", "train.eval_views=1", "scene.validation=0.4")


def test_a_search_prunes_ends_with_a_table_and_is_not_done_twice(small, tmp_path, qnerf):
    store = tmp_path / "runs"
    search = (
        *SEARCH, *small, "hydra.sweeper.n_trials=4", "hydra.sweeper.startup=5",
        "hydra.sweeper.prune={least: 2, percentile: 99}", "train.steps=10", "train.eval_every=5",
        "hydra.sweeper.seed=1",
        "train.lr=tag(log,interval(1e-4,1e-1))",
    )  # fmt: skip
    written = []
    for _ in range(2):
        done = qnerf("run", *search)
        assert done.code == 0, done.err
        written.append({path: (path / "summary.parquet").stat() for path in runs(store)})
        closing = done.out.rpartition("\n\n")[2].strip()
        ends = [(state(path), read_summary(path).get("stopped")) for path in runs(store)]
        assert set(ends) <= {("finished", None), ("interrupted", "pruned")}
        pruned = sum(end[1] == "pruned" for end in ends)
        assert pruned, "the third is between the first two, and only the best of them counts"
        assert closing.startswith(f"best {4 - pruned} of 4 trials (")
        assert f"{pruned} pruned" in closing
        assert closing.count("train.lr=") == 4 - pruned
    assert len(written[0]) == 4
    assert written[0] == written[1]


def test_a_pruned_run_is_interrupted_and_anybody_may_continue_it(tiny):
    config = tiny("train.steps=3", "train.eval_every=1", "train.eval_views=1")
    seen: list[int] = []

    class GivesUp(Display):
        def unpromising(self, path, step, measured):
            seen.append(step)
            return step == 2

    outcome = run(config, display=GivesUp())
    assert (outcome.state, state(outcome.path), outcome.summary["stopped"]) == ("pruned", "interrupted", "pruned")
    assert seen == [1, 2]
    assert outcome.message == "pruned at step 2 of 3: finished runs were better by then"
    again = run(config)
    assert (again.state, again.run_id, again.summary["stopped"]) == ("finished", outcome.run_id, None)


def test_configurations_that_differ_in_nothing_that_acts_are_tried_once(small, tmp_path, qnerf):
    done = qnerf("run", *SEARCH, *small, "field=classical,qcolor", "qiren.layers=1,2")
    assert done.code == 0, done.err
    assert "of 3 trials" in done.out
    assert len(runs(tmp_path / "runs")) == 3


def test_a_search_without_validation_views_is_refused_before_it_trains(small, tmp_path, qnerf):
    done = qnerf("run", *SEARCH, *small, "seed=0,1", "scene.validation=null")
    assert done.err.startswith("error: scene.validation: a search looks at validation views, never at test views")
    assert (done.code, done.err.count("\n"), runs(tmp_path / "runs")) == (1, 1, [])


def test_a_search_where_training_sees_all_points_has_a_seed_of_its_own(tmp_path, qnerf):
    asked = (
        "scene=photograph",
        "scene.size=8",
        "head=mlp",
        "train.steps=3",
        "device=cpu",
        f"store={tmp_path / 'runs'}",
    )
    search = ("-m", "hydra/sweeper=qnerf_optuna", "run.progress=false", *asked, "head.mlp.width=4,5")
    done = qnerf("run", *search)
    assert done.err.startswith("error: seed: this training sees all points")
    assert (done.code, done.err.count("\n"), runs(tmp_path / "runs")) == (1, 1, [])
    assert qnerf("run", *search, f"seed={TUNING[0]}").code == 0
    assert qnerf("tables", str(tmp_path / "runs"), "--rows", "head").out.count("all of a search") == 1


def test_a_search_of_more_than_run_hours_is_refused_after_its_first_trial(small, tmp_path, qnerf):
    long = (*SEARCH, *small, "seed=0,1,2", "train.steps=1", "train.eval_every=0")
    done = qnerf("run", *long, "run.hours=1e-6")
    assert done.code != 0
    assert re.search(r"2 trials more: about \d+ minutes; hydra.sweeper.n_trials takes fewer, or run.hours=1 ", done.err)
    assert len(runs(tmp_path / "runs")) == 1
    assert qnerf("run", *long, "run.hours=1").code == 0
    assert len(runs(tmp_path / "runs")) == 3


def test_a_wrong_search_is_one_line(qnerf):
    mistakes = {
        "seed=1": "a search needs a space",
        "seed=0,1 hydra.sweeper.n_trials=0": "hydra.sweeper.n_trials must be between 1",
        "seed=0,1 hydra.sweeper.prune.percentile=101": "hydra.sweeper.prune.percentile must be between 0 and 100",
        "seed=0,1 hydra.sweeper.objectives=[quality]": "unknown objective 'quality'; known: psnr",
        "seed=0,1 hydra.sweeper.sampler=best": "unknown sampler 'best'; known: tpe, gp, random",
        "color.mlp={layers:2},{layers:3} color.mlp={width:8}": "varies this option, which is given twice; give it once",
        "train.lr=interval(2,1)": "expected two numbers, the smaller one first",
        "train.lr=tag(log,interval(0,1))": "above 0",
    }
    for line, message in mistakes.items():
        done = qnerf("run", *SEARCH, *line.split())
        assert (done.code, message in done.err, done.err.count("\n")) == (2, True, 1), (line, done)


def test_the_space_is_written_as_a_sweep():
    spaces = {
        "a=1,3,2": Choices(("1", "2", "3"), ordered=True),
        "a=1,1.0,true": Choices(("1", "1.0", "True")),
        "a=range(1,4)": Choices(("1", "2", "3"), ordered=True),
        "a=[8,6],null,mlp": Choices(("[8,6]", "null", "mlp")),
        "a=interval(0,1)": Interval(0.0, 1.0),
        "a=int(interval(1,8))": Interval(1, 8, integer=True),
        "a=tag(int,log,interval(1,8))": Interval(1, 8, log=True, integer=True),
        "a=tag(log,interval(1e-4,1e-1))": Interval(1e-4, 1e-1, log=True),
    }
    for typed, values in spaces.items():
        assert values_of(OverridesParser.create().parse_override(typed)) == values
