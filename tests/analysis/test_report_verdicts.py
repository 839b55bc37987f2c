"""The cards of verdicts that open the report and the live page."""

from qnerf.analysis import load
from qnerf.analysis.report import page
from qnerf.analysis.report.verdicts import verdicts

from tests.helpers.configs import ROOT

SEEDS = ROOT / "docs" / "results" / "seeds"


def test_a_card_has_the_verdict_of_the_table_on_each_configuration():
    found = verdicts(load.runs(SEEDS, "color.directions=raw density.mlp.init=he,none"))
    assert list(found.cards) == ["fox_64", "poster"]
    told = {name: (verdict, seeds) for name, verdict, _, seeds in found.cards["fox_64"]}
    assert told["qcolor, 2x64, 1L2S"] == ("undecided: a gain of 0.5 dB is ruled out", "10 / 10 seeds")
    assert told["qboth, 1L2S, 1L2S"][0].startswith("worse")
    assert not found.absent


def test_runs_without_a_baseline_say_what_to_give():
    found = verdicts(load.runs(SEEDS, "field=qcolor,qboth"))
    assert not found.cards
    assert "give --baseline" in found.absent


def test_the_verdicts_stand_before_the_runs():
    html = page.file("page.html")
    assert html.index('id="verdicts-section"') < html.index('id="runs-section"')
