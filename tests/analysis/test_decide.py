"""Seeds on demand: error rates over all looks, races, plans, and a study that is stopped and goes on."""

import dataclasses
import json
import re

import numpy as np
import pandas as pd
import pytest
from qnerf.analysis.decide import __main__ as decide
from qnerf.analysis.decide import study
from qnerf.analysis.decide import tune as tuning
from qnerf.analysis.decide.looks import looks, shares
from qnerf.analysis.decide.records import records
from qnerf.analysis.decide.study import Question, Record
from qnerf.analysis.decide.tune import spaces
from qnerf.analysis.verdict import fisher, verdict
from scipy import stats

from qnerf.building.model import parameter_counts
from qnerf.building.scene import prepare
from qnerf.heads import HEADS
from qnerf.search.objectives import TUNING
from tests.helpers.configs import MOMENT, composed, worked_out


def test_looks_spend_five_percent_together():
    assert list(shares(20)) == looks(20) == [6, 9, 14, 20]
    assert list(shares(20).values()) == pytest.approx([0.0045, 0.005625, 0.014375, 0.0255])
    for most in (2, 4, 5, 11, 20):
        assert looks(most)[-1] == most
        assert sum(shares(most).values()) == pytest.approx(0.05)


def studied(random, spreads, true, within=0.5, most=20):
    """The verdict of a study and its number of seeds a side."""
    one, two = random.normal(0, spreads[0], most), random.normal(true, spreads[1], most)
    for count, alpha in shares(most).items():
        found = verdict(one[:count], two[:count], within, alpha=alpha, metric="ssim")
        if found.kind != "undecided":
            break
    return found.kind, count


@pytest.mark.parametrize("spreads", [(0.35, 0.75), (0.0, 0.6)])
@pytest.mark.parametrize("true", [0.0, 0.5, 1.0])
def test_a_study_is_rarely_wrong_and_ends_early(spreads, true):
    random = np.random.default_rng(2)
    found = [studied(random, spreads, true) for _ in range(500)]
    kinds = [kind for kind, _ in found]
    wrong = kinds.count("worse") + (kinds.count("better") if true == 0 else kinds.count("equivalent"))
    assert wrong <= 38  # 5 % of 500, and 2.6 standard deviations
    if true == 1.0:
        assert kinds.count("better") >= 490
        assert np.mean([count for _, count in found]) < 13


@pytest.mark.parametrize("slipped", [(0, 4), (1, 1), (3, 0), (0, 0)])
def test_slips_are_compared_by_fishers_test(slipped):
    expected = stats.fisher_exact([slipped, np.subtract(9, slipped)]).pvalue
    assert fisher(slipped, (9, 9)) == pytest.approx(expected)
    good = np.linspace(24.0, 24.5, 9)
    sides = [np.r_[good[: 9 - gone], np.full(gone, 9.0)] for gone in slipped]
    found = verdict(*sides, 0.5, alpha=0.1)
    assert (found.slipped, found.uneven) == (slipped, expected < 0.1)


def judged(values, within, metric="psnr", last=False):
    question = Question(tuple(values), ("",), "", within, metric)
    found = decide.judged(question, {name: pd.Series(own) for name, own in values.items()}, 0.01, last=last)
    return {look["candidate"] + look["baseline"]: (look["verdict"].split()[0], look["ended"]) for look in found}


def test_a_race_drops_what_is_worse_and_ends_when_the_rest_is_close():
    noise = 0.1 * np.sin(np.arange(9))
    values = {"a": 20 + noise, "b": 21 + noise, "c": 21.15 - noise}
    assert judged(values, 0.5) == {"ac": ("worse", True), "bc": ("equivalent", True), "ab": ("worse", True)}
    assert judged(values, 0.05)["bc"] == ("undecided:", True)  # no gain over the leader is left to find
    wide = values | {"b": 21 + 5 * noise}
    assert judged(wide, 0.05) == {"ac": ("worse", True), "bc": ("undecided", False), "ab": ("worse", True)}
    assert judged(wide, 0.05, last=True)["bc"] == ("undecided", True)
    lower_is_better = judged({name: own / 30 for name, own in values.items()}, 0.01, "lpips")
    assert set(lower_is_better) == {"ba", "ca"}  # the first one leads


def test_the_first_candidate_is_compared_with_each_other_one_until_it_drops_out(trainings, tmp_path):
    decide.main(["x=d", "x=a", "x=b", "--within", "2", "--store", str(tmp_path)])
    found = records(tmp_path)
    pairs = dict(
        zip(found["candidate"] + " - " + found["baseline"], found["verdict"].str.split(":").str[0], strict=True)
    )
    assert pairs == {"x=d - x=b": "worse", "x=d - x=a": "worse", "x=a - x=b": "undecided"}


VALUES = {"x=a": 20.0, "x=b": 20.9, "x=c": 18.0, "x=d": 10.0, "y=1": 20.0}


class Trainings:
    """Trainings that end at once, of which the `stopped`th is interrupted."""

    def __init__(self):
        self.asked = []
        self.stopped = None
        self.contents = ""  # of the scene
        self.seconds = 30.0
        self.created = np.inf  # after every record

    def __call__(self, overrides, seeds, store, foresee):
        foresee(self.seconds)
        if self.stopped == 0:
            self.stopped = None
            raise KeyboardInterrupt
        self.stopped = self.stopped and self.stopped - 1
        self.asked.append((overrides, list(seeds)))
        name = next(item for item in overrides if item in VALUES)
        psnr = [VALUES[name] + 0.5 * np.sin(7 * n + len(name)) + 0.3 * np.cos(n * VALUES[name]) for n in seeds]
        rows = {
            "psnr": psnr,
            "state": "finished",
            "train_s": self.seconds,
            "step_cpu_ms": 40.0 if "k=2" in overrides else {"x=a": 10.0}.get(name, 20.0),
            "train.steps": 100,
            "created": self.created,
        }
        return pd.DataFrame(rows, index=[f"{' '.join(overrides)} {n}" for n in seeds])


@pytest.fixture
def trainings(monkeypatch):
    made = Trainings()
    monkeypatch.setattr(decide, "trained", made)
    monkeypatch.setattr(study, "run_ids", lambda overrides, seeds, store: [f"s-{made.contents}{' '.join(overrides)}"])
    return made


def test_a_study_stops_at_the_verdict_and_keeps_its_record(trainings, tmp_path, capsys):
    decide.main(["x=a", "x=b", "--store", str(tmp_path), "--budget", "1h"])
    said = capsys.readouterr().out
    assert "\n6 seeds: x=b - x=a: +0." in said
    assert "(99.55 %)" in said
    assert "next look at 9 seeds, about 3 minutes of training more" in said
    (row,) = records(tmp_path).to_dict("records")
    assert (row["baseline"], row["candidate"], row["most"], row["ended"]) == ("x=a", "x=b", 20, True)
    assert row["verdict"].startswith("better")
    trainings.asked.clear()
    decide.main(["x=a", "x=b", "--store", str(tmp_path), "--budget", "9h"])
    assert trainings.asked == []  # decided once
    assert capsys.readouterr().out.strip() == said.splitlines()[-1]


def test_a_study_goes_on_where_it_was_stopped(trainings, tmp_path):
    whole = tmp_path / "whole"
    decide.main(["x=a", "x=b", "--store", str(whole)])
    trainings.stopped = 3
    with pytest.raises(KeyboardInterrupt):
        decide.main(["x=a", "x=b", "--store", str(tmp_path)])
    decide.main(["x=a", "x=b", "--store", str(tmp_path)])
    here, there = (records(store).drop(columns="registered") for store in (tmp_path, whole))
    assert here.equals(there)


def test_a_record_names_the_scene_that_all_candidates_have(trainings, tmp_path):
    decide.main(["x=a", "x=b", "--all", "scene=photograph scene.path=pictures/camera", "--store", str(tmp_path)])
    assert set(records(tmp_path)["scene"]) == {"camera"}


def test_a_study_says_its_whole_time_before_its_first_run_is_trained(trainings, tmp_path, capsys):
    decide.main(["x=a", "x=b", "--store", str(tmp_path), "--budget", "9m"])
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("the whole study, up to 9 seeds of 2 configurations: about 9 minutes; ")
    trainings.seconds, trainings.asked = 4 * 3600.0, []
    with pytest.raises(ValueError, match=r"about 2,880 minutes; .* or --budget 96h goes on"):
        decide.main(["x=a", "x=c", "--store", str(tmp_path)])
    assert trainings.asked == []
    decide.main(["x=a", "x=c", "--store", str(tmp_path), "--budget", "96h"])
    assert trainings.asked


def test_a_study_that_is_refused_ends_its_training(tmp_path, monkeypatch, capsys):
    training = tmp_path / "training"
    ended = tmp_path / "ended"
    training.write_text(
        f"#!/bin/sh\ntrap 'touch {ended}; exit 130' TERM\necho 'note: no effect in any job: y'\n"
        "echo 'a step takes about 0.04 s, the whole 1,234.5 hours'\n"
        "while :; do sleep 0.1; done\n"
    )
    training.chmod(0o755)
    monkeypatch.setattr(study.sys, "executable", str(training))
    heard = []

    def foresee(seconds):
        heard.append(seconds)
        raise ValueError("too long")

    for _ in range(2):
        with pytest.raises(ValueError, match="too long"):
            study.trained(["x=a"], [0], tmp_path, foresee)
    assert capsys.readouterr().out.count("note: no effect in any job: y\n") == 1
    assert heard == [pytest.approx(1234.5 * 3600)] * 2
    assert ended.exists()


def test_the_last_look_is_not_moved(trainings, tmp_path):
    question = Question(("x=a", "y=1"), ("",), "", 0.01)
    decide.study(Record.of(question, tmp_path), tmp_path, 6 * 60)
    record = Record.of(question, tmp_path)
    assert record.most == 6
    assert record.looks[-1]["seeds"] == 6
    decide.study(record, tmp_path, 1e6)
    assert Record.of(question, tmp_path).looks == record.looks


def test_another_scene_behind_the_same_words_is_another_study(trainings, tmp_path):
    asked = ["x=a", "x=b", "--scene", "scene.path=fox", "--store", str(tmp_path)]
    decide.main(asked)
    (path,) = tmp_path.glob(".decisions/*.json")
    assert [len(ids) for ids in json.loads(path.read_text())["runs"].values()] == [9, 9]
    trainings.asked.clear()
    trainings.contents = "replaced"
    decide.main(asked)
    assert len(trainings.asked) == 4  # two candidates, two looks
    assert len(list(tmp_path.glob(".decisions/*.json"))) == 2


def test_several_all_are_one(trainings, tmp_path):
    decide.main(["x=a", "x=b", "--all", "train.steps=5", "--all", "y=1", "--store", str(tmp_path)])
    assert trainings.asked[0][0] == ["train.steps=5", "y=1", "x=a"]


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        (["field=qcolor seed=1", "field=classical"], "seed=1: the study chooses the seeds"),
        (["field=qcolor", "field=classical", "--all", "seed=0,1"], "seed=0,1: the study chooses the seeds"),
        (["field=qcolor", "field=classical", "--scene", "scene=poster +seed=2"], "seed=2: the study chooses"),
        (
            ["field=qcolor", "field=classical", "--all", "store=s"],
            "store=s: the store is an option of its own, --store",
        ),
        (["field=qcolor", "field=classical", "--all", "run.force=true"], "run.force=true: finished runs count"),
        (["field=qcolor,qboth", "field=classical"], "field=qcolor,qboth: expected one value in a candidate"),
        (["head=mlp", "head=siren", "scene=photograph"], "scene=photograph: .* --scene or --all scene=photograph"),
        (["head=mlp", "head=siren", "--tune", "2", "--space", "train.steps=5,9"], "is the same for all candidates"),
        (["head=mlp", "head=siren", "--tune", "-1"], "--tune -1: expected a number of trials, 1 or more"),
        (["head=mlp", "head=siren", "--space", "head.mlp.width=8,16"], "--space .*: is of a search; give --tune N"),
        (
            ["head=mlp", "head=siren", "--tune", "2", "--space", "head.mlp.width=8"],
            "--space head.mlp.width=8: expected several values; one value stands in a candidate or in --all",
        ),
        (
            ["head=mlp", "head=siren", "--tune", "2", *["--space", "head.mlp.width=8,16"] * 2],
            "--space: expected each option once",
        ),
        (
            ["head=mlp", "head=siren", "--all", "train.rays=8", "train.steps=2"],
            "train.steps=2: sets none of head, .* it is --all train.steps=2",
        ),
    ],
)
def test_decide_refuses_what_a_study_cannot_honour(asked, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        decide.main([*asked, "--store", str(tmp_path)])


def test_a_metric_that_the_runs_lack_is_named(trainings, tmp_path):
    with pytest.raises(ValueError, match=r"^x=a: no ssim; choose another --metric: psnr, train_s"):
        decide.main(["x=a", "x=b", "--metric", "ssim", "--store", str(tmp_path)])
    with pytest.raises(ValueError, match=r"^--metric accuracy: measured by no run; known: psnr, "):
        decide.main(["x=a", "x=b", "--metric", "accuracy", "--within", "1", "--store", str(tmp_path)])


def test_several_candidates_race(trainings, tmp_path):
    decide.main(["x=a", "x=b", "x=c", "--within", "2", "--store", str(tmp_path)])
    found = records(tmp_path).set_index(["candidate", "baseline"])["verdict"]
    assert found["x=c", "x=b"] == "worse"
    assert found["x=a", "x=b"] == "undecided: a gain of 2 dB is ruled out"
    assert max(len(seeds) for overrides, seeds in trainings.asked if "x=c" in overrides) < 20


def test_equal_time_measures_once_and_gives_the_cheaper_side_more_steps(trainings, tmp_path, capsys):
    asked = ["x=a", "x=b", "--equal", "time", "--store", str(tmp_path)]
    trainings.stopped = 2  # killed after both were measured
    with pytest.raises(KeyboardInterrupt):
        decide.main(asked)
    assert "x=a: 10.0 ms of CPU a step, so 200 steps" in capsys.readouterr().out
    decide.main(asked)
    assert "ms of CPU" not in capsys.readouterr().out
    assert any("train.steps=200" in overrides for overrides, _ in trainings.asked)
    assert set(records(tmp_path)["steps"]) == {"x=a 200, x=b 100"}


def test_the_record_is_written_before_the_first_run_and_keeps_later_budgets(trainings, tmp_path):
    trainings.stopped = 0
    with pytest.raises(KeyboardInterrupt):
        decide.main(["x=a", "x=b", "--budget", "1h", "--store", str(tmp_path)])
    assert records(tmp_path)[["candidate", "seeds", "verdict"]].values.tolist() == [["x=b", 0, "no look yet"]]
    (path,) = tmp_path.glob(".decisions/*.json")
    first = json.loads(path.read_text())["registered"]
    for _ in range(2):
        decide.main(["x=a", "x=b", "--budget", "2h", "--store", str(tmp_path)])
    kept = json.loads(path.read_text())
    assert (kept["registered"], [change["budget"] for change in kept["changes"]]) == (first, [7200])
    assert "budget 7200 s at" in records(tmp_path)["changes"].iloc[0]
    trainings.created = 0.0
    decide.main(["x=a", "x=c", "--store", str(tmp_path)])
    told = "12 of 12 judged runs are older than the record; 6 judged runs stand in an earlier record, too"
    path.write_text(path.read_text().replace(first["time"], "2000-01-01T00:00:00+00:00"))
    assert told in set(records(tmp_path)["changes"])
    assert (first["looks"], first["tuning_seeds"]) == ([6, 9, 14, 20], [])


SIRENS = ("color=mlp color.mlp.layers=3", "color=siren")
SMALL = " ".join(("field=classical", *MOMENT, "scene.views=4"))


def test_the_space_is_that_of_the_heads_in_which_candidates_differ():
    question = Question(SIRENS, ("",), SMALL, 0.5, tune=4, space=("color.siren.omega=5,10", "color.mlp.width=8,16"))
    found = spaces(Record(question, ""), "")
    rate = {"train.rates.color": "tag(log,interval(0.1,3))"}
    assert found[SIRENS[0]] == {**rate, "color.mlp.init": "torch,he", "color.mlp.width": "8,16"}
    assert found[SIRENS[1]]["color.siren.omega"] == "5,10"
    shared = dataclasses.replace(question, common=f"{SMALL} color.mlp.init=he train.rates.color=1")
    assert set(spaces(Record(shared, ""), "")[SIRENS[0]]) == {"color.mlp.width"}  # what all have stays
    bare = dataclasses.replace(question, candidates=("color=mlp", "color=siren"))
    assert "color.mlp" not in spaces(Record(bare, ""), "")["color=mlp"]  # no depth against a width that is asked for
    with pytest.raises(
        ValueError, match=r"^--space density.siren.omega: searched in no candidate; known: color.mlp.init"
    ):
        spaces(Record(dataclasses.replace(question, space=("density.siren.omega=8,9",)), ""), "")


def test_depth_is_searched_with_the_width_that_keeps_the_number_of_parameters():
    found = spaces(Record(Question(("color=mlp", "color=qkan"), ("",), SMALL, 0.5, tune=4), ""), "")
    for name in ("color.mlp", "color.qkan"):
        pairs = found[name.replace(".", "=")][name]
        counts = []
        for layers, width in re.findall(r"layers:(\d+),width:(\d+)", pairs):
            made = [f"{name.replace('.', '=')}", f"{name}.layers={layers}", f"{name}.width={width}"]
            prepared = prepare(worked_out(*SMALL.split(), *made))
            prepared.task.build(prepared.settings)
            counts.append(parameter_counts(prepared.task.model)["params.color"])
        assert len(counts) > 1
        assert counts == pytest.approx([counts[0]] * len(counts), rel=0.1)


def test_every_head_has_a_space_of_five_options_at_most():
    for name in HEADS.names():
        own = composed(f"color={name}")["color"]["space"]
        assert 1 <= len(own) <= 5
        known = {option.name for option in worked_out("field=qcolor", f"color={name}").options}
        assert {f"color.{key}" for key in own if key != "rate"} <= known, name


def test_the_expected_best_of_several_trials():
    values = np.random.default_rng(0).normal(size=6)
    drawn = np.random.default_rng(1).choice(values, (20000, 3))
    assert tuning.expected(values, 1)[2] == pytest.approx(drawn.max(axis=1).mean(), abs=0.02)
    assert tuning.expected(values, -1)[2] == pytest.approx(drawn.min(axis=1).mean(), abs=0.02)


def test_a_lucky_trial_is_not_chosen_and_a_search_is_done_once(trainings, tmp_path, monkeypatch):
    """The best of the search is trained again with two new seeds; what it says there decides. A kill loses nothing."""
    scores = {"omega=1": (25.0, 20.0), "omega=2": (24.0, 23.0), "omega=3": (22.0, 22.0), "omega=4": (26.0, np.nan)}
    asked = []

    def searched(record, count, overrides, space, store, foresee):
        asked.append((count, overrides))
        own = {"state": "finished", "values": [20.0], "overrides": ["omega=30"], "runs": ["own"]}
        return [own, *(own | {"values": [scores[key][0]], "overrides": [key], "runs": [key]} for key in scores)][:count]

    def again(overrides, seeds, store, foresee):
        assert "scene.validation=0.1" in overrides
        if list(seeds) == [TUNING[0]]:  # its own options, the first trial
            return pd.DataFrame({"psnr": [20.0]}, index=["own"])
        assert list(seeds) == list(TUNING[1:])
        return pd.DataFrame({"psnr": [scores[overrides[-1]][1], 30.0 if overrides[-1] == "omega=4" else 23.0]})

    monkeypatch.setattr(tuning, "searched", searched)
    monkeypatch.setattr(tuning, "trained", again)
    monkeypatch.setattr(tuning, "found", lambda *_: pd.DataFrame({"train_s": [30.0]}))
    record = Record(Question(SIRENS, ("scene=poster",), "field=classical", 0.5, tune=5), "x")
    record.spaces = {f"poster: {name}": {} for name in SIRENS}
    tuning.tune(record, "scene=poster", tmp_path, [].append)
    assert [one["chosen"] for one in record.tuned.values()] == [["omega=2"]] * 2  # omega=4 diverged on a new seed
    assert record.words("scene=poster", SIRENS[1])[-1] == "omega=2"
    one = record.tuned[f"poster: {SIRENS[0]}"]
    assert [trial[0] for trial in one["scores"]] == [[], *([key] for key in scores)]  # its own options once
    assert (one["trials"], one["seconds"], len(one["expected"])) == (5, 8 * 30.0, 5)
    assert all(f"seed={TUNING[0]}" in overrides for _, overrides in asked)
    before = len(asked)
    tuning.tune(record, "scene=poster", tmp_path, [].append)
    assert len(asked) == before


def test_a_search_is_registered_with_its_spaces_and_counts_in_the_budget(trainings, tmp_path, monkeypatch):
    def tune(record, scene, store, foresee):
        (path,) = tmp_path.glob(".decisions/*.json")
        assert json.loads(path.read_text())["spaces"] == {"x=a": {"k": "1,2"}, "x=b": {"k": "3,4"}}
        record.tuned = {
            name: {"seconds": 200.0, "chosen": [], "trials": 2, "expected": [1.0], "validation": 0.1}
            for name in ("x=a", "x=b")
        }

    monkeypatch.setattr(decide, "spaces", lambda record, scene: {"x=a": {"k": "1,2"}, "x=b": {"k": "3,4"}})
    monkeypatch.setattr(decide, "tune", tune)
    decide.main(["x=a", "x=b", "--tune", "2", "--budget", "1000s", "--store", str(tmp_path)])
    assert set(records(tmp_path)["most"]) == {10}  # (1000 - 400) / 60
    assert set(records(tmp_path)["spaces"]) == {"x=a: k=1,2; x=b: k=3,4"}


def test_a_search_at_equal_time_has_it_too_and_what_it_chose_is_measured_again(trainings, tmp_path, monkeypatch):
    searched = []

    def tune(record, scene, store, foresee):
        searched.append(dict(record.steps))
        found = {"seconds": 20.0, "trials": 2, "expected": [1.0], "validation": 0.1}
        record.tuned = {"x=a": found | {"chosen": ["k=2"]}, "x=b": found | {"chosen": []}}

    monkeypatch.setattr(decide, "spaces", lambda record, scene: {"x=a": {"k": "1,2"}, "x=b": {"k": "1,2"}})
    monkeypatch.setattr(decide, "tune", tune)
    decide.main(["x=a", "x=b", "--tune", "2", "--equal", "time", "--store", str(tmp_path)])
    assert searched == [{"x=a": 200, "x=b": 100}]
    assert set(records(tmp_path)["steps"]) == {"x=a 100, x=b 200"}  # k=2 costs twice as much as x=b


def test_two_processes_of_a_study_share_its_record(tmp_path):
    one, other = (Record(Question(SIRENS, ("",), SMALL, 0.5), "x") for _ in range(2))
    one.register(60.0, tmp_path)
    other.register(90.0, tmp_path)
    one.most, one.looks = 20, [{"seeds": 6}]
    one.save(tmp_path)
    other.tuned = {"x=a": {"trials": 2}}
    other.save(tmp_path)
    found = json.loads((tmp_path / ".decisions" / "x.json").read_text())
    assert (found["most"], found["looks"], found["tuned"]) == (20, [{"seeds": 6}], {"x=a": {"trials": 2}})
    assert (found["registered"]["budget"], found["changes"][0]["budget"]) == (60.0, 90.0)


def test_a_candidate_of_which_runs_diverge_does_not_lead():
    noise = np.array([0.1, -0.1, 0.2, -0.2, 0.0, 0.05])
    values = {"a": np.r_[[np.nan] * 2, 30 + noise[2:]], "b": 20 + noise, "c": 19 + noise}
    question = Question(("a", "b", "c"), ("",), "", 0.5)
    found = decide.judged(question, {name: pd.Series(own) for name, own in values.items()}, 0.05, last=False)
    assert [(look["candidate"], look["baseline"]) for look in found] == [("a", "b"), ("c", "b"), ("a", "c")]


def test_scenes_are_named_by_their_folders(trainings, tmp_path):
    question = ["x=a", "x=b", "--store", str(tmp_path), "--scene", "scene=llff scene.path=/data/fern scene.width=64"]
    decide.main([*question, "--scene", "scene=room"])
    assert list(records(tmp_path)["scene"]) == ["fern", "room"]
    with pytest.raises(ValueError, match="scenes of different names, got fern, fern"):
        decide.main([*question, "--scene", "scene.path=other/fern"])


def test_decide_names_mistakes_of_candidates_scenes_and_times(tmp_path, capsys):
    with pytest.raises(ValueError, match="expected at least two candidates, each once, got field=qcolor"):
        decide.main(["field=qcolor"])
    with pytest.raises(ValueError, match=r"^density=mlp: the same configuration as field=qcolor; leave one out"):
        decide.main(["field=qcolor", "density=mlp", "--store", str(tmp_path)])
    with pytest.raises(ValueError, match="scene=room: unknown; known: blender, "):
        decide.main(["field=qcolor", "field=qdensity", "--scene", "scene=room", "--store", str(tmp_path)])
    with pytest.raises(SystemExit):
        decide.main(["a", "b", "--budget", "soon"])
    assert "expected a time such as 90s, 30m, 2h or 1d, got 'soon'" in capsys.readouterr().err
