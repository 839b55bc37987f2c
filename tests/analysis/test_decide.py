"""Seeds on demand: error rates over all looks, races, plans, and a study that is stopped and goes on."""

import numpy as np
import pandas as pd
import pytest
from qnerf.analysis.decide import __main__ as decide
from qnerf.analysis.decide.looks import affordable, look, looks, planned, race, seeds_needed, shares
from qnerf.analysis.decide.study import Question, Record, records


def test_looks_spend_five_percent_together():
    assert looks(20) == [4, 6, 9, 14, 20]
    assert shares(20) == pytest.approx([0.002, 0.0025, 0.005625, 0.014375, 0.0255])
    for most in (2, 4, 5, 11, 20):
        assert looks(most)[-1] == most
        assert sum(shares(most)) == pytest.approx(0.05)
    assert [affordable(budget, 60) for budget in (1, 600, 1e6)] == [4, 10, 20]


def studied(random, spreads, true, within=0.5, most=20):
    """The verdict of a study and its number of seeds a side."""
    one, two = random.normal(0, spreads[0], most), random.normal(true, spreads[1], most)
    for count, alpha in zip(looks(most), shares(most), strict=True):
        found, _ = look(one[:count], two[:count], within, alpha, "ssim")
        if found.kind != "undecided":
            break
    return found.kind, count


@pytest.mark.parametrize("spreads", [(0.35, 0.75), (0.5, 0.5), (0.0, 0.6)])
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


def test_collapses_are_compared_by_fishers_test():
    good = np.linspace(24.0, 24.5, 9)
    found, p = look(good, np.r_[good[:5], np.full(3, 9.0), np.nan], 0.5, 0.05)
    assert found.collapsed == (0, 4)
    assert p == pytest.approx(0.0824, abs=1e-3)


def test_a_race_drops_what_is_worse_and_ends_when_the_rest_is_close():
    noise = 0.1 * np.sin(np.arange(9))
    values = {"a": 20 + noise, "b": 21 + noise, "c": 21.02 - noise}
    best, worse, close = race(values, 0.5, 0.01)
    assert ({best, *worse}, close) == ({best, "a"}, True)
    assert best == "b" or best == "c"
    assert not race(values, 0.05, 0.01)[2]
    assert race(values, 0.5, 0.01, sign=-1)[0] == "a"


def test_a_plan_has_the_power_that_it_says():
    random = np.random.default_rng(3)
    for difference, wanted in ((0.0, "equivalent"), (1.0, "better")):
        count = round(seeds_needed((0.5, 0.5), 0.5, difference) / 1.15)
        kinds = [
            look(random.normal(0, 0.5, count), random.normal(difference, 0.5, count), 0.5, 0.05, "ssim")[0].kind
            for _ in range(400)
        ]
        assert 0.74 <= kinds.count(wanted) / 400 <= 0.92
    low, high = planned([20.0, 20.6, 21.0, 20.2], [20.1, 20.4, 21.1, 20.3], 0.5)
    assert 2 * low < high


@pytest.fixture
def trainings(monkeypatch):
    """Trainings that end at once: `trained[name, seed]`, and what was asked for."""
    asked = []
    values = {"a": 20.0, "b": 20.9, "c": 18.0}

    def results(store, overrides, seeds):
        name = overrides[-1].partition("=")[2] if overrides[-1].startswith("x=") else "a"
        psnr = [values[name] + 0.5 * np.sin(7 * seed + len(name)) + 0.3 * np.cos(seed * values[name]) for seed in seeds]
        return pd.DataFrame({"psnr": psnr, "train_s": 30.0, "step_cpu_ms": {"a": 10.0}.get(name, 20.0)}).assign(
            **{"train.steps": 100}
        )

    monkeypatch.setattr(decide, "train", lambda overrides, seeds: asked.append((overrides, list(seeds))))
    monkeypatch.setattr(decide, "results", results)
    return asked


def test_a_study_stops_at_the_verdict_and_keeps_its_record(trainings, tmp_path, capsys):
    decide.main(["x=a", "x=b", "--store", str(tmp_path), "--budget", "1h"])
    said = capsys.readouterr().out
    assert said.splitlines()[1].startswith("4 seeds: x=b - x=a: +0.")
    assert "(99.8 %)" in said
    assert "next look at 6 seeds, about 2 minutes more" in said
    (row,) = records(tmp_path).to_dict("records")
    assert (row["baseline"], row["comparison"], row["most"]) == ("x=a", "x=b", 20)
    assert row["verdict"].startswith("better")
    trainings.clear()
    decide.main(["x=a", "x=b", "--store", str(tmp_path), "--budget", "9h"])
    assert trainings == []  # decided once
    assert capsys.readouterr().out == f"x=b: {row['verdict']}\n"


def test_a_study_goes_on_where_it_was_stopped(trainings, tmp_path, monkeypatch, capsys):
    whole = tmp_path / "whole"
    decide.main(["x=a", "x=b", "--store", str(whole)])
    stop = iter([False] * 3 + [True])

    def train(overrides, seeds):
        if next(stop, False):
            raise KeyboardInterrupt

    monkeypatch.setattr(decide, "train", train)
    with pytest.raises(KeyboardInterrupt):
        decide.main(["x=a", "x=b", "--store", str(tmp_path)])
    decide.main(["x=a", "x=b", "--store", str(tmp_path)])
    assert records(tmp_path).equals(records(whole))


def test_the_last_look_is_not_moved(trainings, tmp_path):
    question = Question(("x=a", "y=1"), ("",), "", 0.01)
    decide.Study(question, Record.of(question, tmp_path), tmp_path, 6 * 60).run()
    record = Record.of(question, tmp_path)
    assert record.most == 6
    assert record.looks[-1]["seeds"] == 6
    decide.Study(question, record, tmp_path, 1e6).run()
    assert Record.of(question, tmp_path).looks == record.looks


def test_several_candidates_race(trainings, tmp_path):
    decide.main(["x=a", "x=b", "x=c", "--within", "2", "--store", str(tmp_path)])
    verdicts = records(tmp_path).set_index("comparison")["verdict"]
    assert verdicts["x=c"] == "worse than x=b"
    assert verdicts["x=b"] == "the best"
    assert max(len(seeds) for overrides, seeds in trainings if "x=c" in overrides) < 20


def test_equal_time_measures_once_and_gives_the_cheaper_side_more_steps(trainings, tmp_path, monkeypatch, capsys):
    asked = ["x=a", "x=b", "--equal", "time", "--store", str(tmp_path)]
    stop = iter([False, False, True])  # killed after both were measured

    def train(overrides, seeds):
        if next(stop, False):
            raise KeyboardInterrupt
        trainings.append((overrides, list(seeds)))

    monkeypatch.setattr(decide, "train", train)
    with pytest.raises(KeyboardInterrupt):
        decide.main(asked)
    assert "x=a: 10.0 ms of CPU a step, so 200 steps" in capsys.readouterr().out
    decide.main(asked)
    assert "ms of CPU" not in capsys.readouterr().out
    assert any("train.steps=200" in overrides for overrides, _ in trainings)
    assert set(records(tmp_path)["steps"]) == {"x=a 200, x=b 100"}


def test_scenes_are_named_by_their_folders(trainings, tmp_path):
    question = ["x=a", "x=b", "--store", str(tmp_path), "--scene", "scene=llff scene.path=/data/fern scene.width=64"]
    decide.main([*question, "--scene", "scene=room"])
    assert set(records(tmp_path)["comparison"]) == {"fern: x=b", "room: x=b"}
    with pytest.raises(ValueError, match="scenes of different names, got fern, fern"):
        decide.main([*question, "--scene", "scene.path=other/fern"])


def test_mistakes_are_named(tmp_path, capsys):
    with pytest.raises(ValueError, match="expected at least two candidates, got field=qcolor"):
        decide.main(["field=qcolor"])
    with pytest.raises(SystemExit):
        decide.main(["a", "b", "--budget", "soon"])
    assert "expected a time such as 90s, 30m, 2h or 1d, got 'soon'" in capsys.readouterr().err
