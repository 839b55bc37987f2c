"""The cards of verdicts that open the report and the live page."""

import pandas as pd
from qnerf.analysis import load
from qnerf.analysis.decide.records import searched
from qnerf.analysis.report import page
from qnerf.analysis.report.verdicts import verdicts

from tests.helpers.configs import ROOT

SEEDS = ROOT / "docs" / "results" / "seeds"


def test_a_card_has_the_verdict_of_the_table_on_each_configuration():
    found = verdicts(load.runs(SEEDS, "color.directions=raw density.mlp.init=he,none"))
    assert list(found.cards) == ["fox_64", "poster"]
    told = {name: (verdict, seeds) for name, verdict, _, seeds, _ in found.cards["fox_64"]}
    assert told["qcolor, 2x64, 1L2S"] == ("undecided: a gain of 0.5 dB is ruled out", "10 / 10 seeds")
    assert told["qboth, 1L2S, 1L2S"][0].startswith("worse")
    assert not found.absent


def test_a_card_opens_with_what_a_study_decided_and_how_it_was_searched(monkeypatch):
    tuned = {"poster: b": {"chosen": ["omega=2"], "trials": 4, "seconds": 90.0, "expected": [20.0, 21.5]}}
    tuned["poster: b"]["validation"] = "other seeds"
    look = {"scene": "poster", "baseline": "a", "candidate": "b", "seeds": 6, "shown": "+0.61 ± 0.20", "metric": "psnr"}
    how = searched(tuned, look)
    assert how == "b: omega=2 (4 trials, 1.5 minutes, expected best 20 of 1, 21.5 of 2, other seeds)"
    rows = pd.DataFrame([look | {"verdict": "better, after 4 trials each", "searched": how}])
    monkeypatch.setattr("qnerf.analysis.report.verdicts.records", lambda store: rows)
    line = ("b - a", "better, after 4 trials each", "+0.61 ± 0.20 dB", "6 seeds, registered study", how)
    found = verdicts(load.runs(SEEDS, "color.directions=raw density.mlp.init=he,none"))
    assert (found.cards["poster"][0], len(found.cards["poster"]) > 1) == (line, True)
    alone = verdicts(load.runs(SEEDS, "field=qcolor,qboth"))
    assert (alone.cards, alone.absent) == ({"poster": [line]}, "")


def test_runs_without_a_baseline_say_what_to_give():
    found = verdicts(load.runs(SEEDS, "field=qcolor,qboth"))
    assert not found.cards
    assert "give --baseline" in found.absent


def test_the_verdicts_stand_before_the_runs():
    html = page.file("page.html")
    assert html.index('id="verdicts-section"') < html.index('id="runs-section"')
