import json
from pathlib import Path

import pandas as pd
import pytest
from omegaconf import OmegaConf
from qnerf.analysis import load

from qnerf import records
from qnerf.cli.launch import _rename_swept
from qnerf.cli.overrides import translated
from qnerf.config import compatibility
from qnerf.config.compatibility import (
    ADDED,
    RENAMED,
    fill_added,
    old_form,
    today,
    upgrade_config,
    without_neutral,
)
from qnerf.config.identity import flatten, identity
from qnerf.config.settings import settings_from
from qnerf.model.labels import slug
from qnerf.records import RunStore, filters, index
from tests.helpers.configs import composed

GOLDEN = json.loads((Path(__file__).parent / "golden_ids.json").read_text())
PAPER = {"train=paper", "experiment=paper_samples"}


@pytest.mark.parametrize("run", GOLDEN["runs"], ids=lambda run: run["overrides"])
def test_every_run_keeps_its_id(run):
    """As it was before options got new names, from the command as it was typed then.

    `train=quick` has had fewer samples since.
    """
    typed = run["overrides"].split()
    config = composed(*typed, *([] if PAPER & set(typed) else ["proposal.samples=[128,64]"]))
    assert (slug(config), identity(config), identity(config, "abc")) == (run["slug"], run["id"], run["of scene abc"])


@pytest.mark.parametrize("stored", GOLDEN["stored"], ids=lambda stored: stored["id"])
def test_a_stored_configuration_keeps_its_id_in_today_s_form(stored):
    config = stored["config"]
    upgraded = upgrade_config(config)
    assert identity(config) == identity(upgraded) == stored["id"]
    assert upgrade_config(upgraded) == upgraded
    fill_added(upgraded)
    assert identity(upgraded) == stored["id"]
    if upgraded["needs"]["name"] != "auto":  # which would have to be decided first
        settings_from(upgraded)


def test_every_old_name_has_a_new_one_and_comes_back():
    config = composed("shading=threshold")
    flat = flatten(config)
    for new, old in RENAMED.items():
        assert today(old) == today(new) == new
        assert today(f"needs.{old}.value") == f"needs.{new}.value"
        assert any(f"{name}.".startswith(f"{new}.") for name in flat), f"{new} is no option"
    before = flatten(old_form(config))
    assert not any(f"{name}.".startswith(f"{new}.") for name in before for new in RENAMED)
    assert upgrade_config(old_form(config)) == without_neutral(config)


@pytest.mark.parametrize(
    ("override", "same"),
    [
        ("color.qfgn.features=8", False),
        ("color.qfgn.features=16", True),
        ("qiren.ansatz_options.qiren.axis=X", False),
        ("qiren.ansatz_options.qiren.axis=Z", True),
        ("plugins=[a]", False),
        ("plugins=[]", True),
        ("numerics.finite_checks=true", True),
    ],
)
def test_an_added_option_enters_the_id_only_where_it_changes_something(override, same):
    assert (identity(composed(override)) == identity(composed())) is same


def test_an_added_option_that_follows_another_one_does_not_enter():
    """color.qfgn.features is qfgn.features unless it is set."""
    assert identity(composed("qfgn.features=8")) == identity(composed("qfgn.features=8", "color.qfgn.features=8"))
    assert identity(composed("qfgn.features=8")) != identity(composed("qfgn.features=8", "color.qfgn.features=16"))


def test_an_older_run_gets_the_values_that_it_had_without_an_option():
    config = upgrade_config(GOLDEN["stored"][0]["config"])
    config["qfgn"]["features"] = 8
    fill_added(config)
    assert config["density"]["qfgn"]["features"] == 8
    assert config["plugins"] == []
    assert config["color"]["qiren"]["ansatz_options"] == ADDED["qiren.ansatz_options"]
    assert config["color"]["qiren"]["ansatz_options"] is not config["qiren"]["ansatz_options"]


@pytest.mark.parametrize(
    "config",
    [{}, {"gate": 5}, {"gate": {}, "shading": 5}, {"density": 3, 4: {"gate": 1}}, {"needs": {"gate.name": 1, 2: 3}}],
)
def test_what_is_no_configuration_is_renamed_without_an_error(config):
    upgraded = upgrade_config(config)
    assert "gate" not in upgraded
    assert upgrade_config(upgraded) == upgraded


@pytest.mark.parametrize(
    ("typed", "expected", "noted"),
    [
        ("gate=none,merge", "shading=none,merge", "gate is called shading now\n"),
        ("+gate.least=1e-2", "+shading.min_share=1e-2", "gate.least is called shading.min_share now\n"),
        ("++density.width=8,16", "++density.mlp.width=8,16", "density.width is called density.mlp.width now\n"),
        ("~poses.seed", "~pose_noise.seed", "poses.seed is called pose_noise.seed now\n"),
        ("hydra.sweeper.params.gate=top", "hydra.sweeper.params.shading=top", "gate is called shading now\n"),
        ("density=qiren", "head@density=qiren", ""),
        ("color=mlp,qfgn", "head@color=mlp,qfgn", ""),
        ("density={mlp: {width: 3}}", "density={mlp: {width: 3}}", ""),
        ("density.initial=0.1", "density.initial=0.1", ""),
        ("color.name=qfgn", "color.name=qfgn", ""),
        ("store=runs/gate=none", "store=runs/gate=none", ""),
        ("-m", "-m", ""),
        ("--config-dir=gate", "--config-dir=gate", ""),
        ("gate", "gate", ""),
    ],
)
def test_an_override_is_translated_and_noted_once(monkeypatch, capsys, typed, expected, noted):
    monkeypatch.setattr(compatibility, "_noted", set())
    assert translated([typed, typed]) == [expected, expected]
    assert capsys.readouterr().err == noted


def test_a_sweep_s_file_may_have_old_names():
    swept = OmegaConf.create({"hydra": {"sweeper": {"params": {"gate": "none,top", "density": "mlp", "seed": "0,1"}}}})
    _rename_swept(swept)
    assert swept.hydra.sweeper.params == {"shading": "none,top", "head@density": "mlp", "seed": "0,1"}


def test_filters_and_tables_know_old_names(capsys, monkeypatch):
    monkeypatch.setattr(compatibility, "_noted", set())
    frame = pd.DataFrame({"shading": ["merge", "none"], "density.mlp.init": ["he", "torch"]})
    assert filters.select(frame, filters.parse(["gate=merge"]))["density.mlp.init"].tolist() == ["he"]
    assert filters.require(frame, {"density.init": "torch"})["shading"].tolist() == ["none"]
    assert [item.key for item in filters.parse("density.init=he")] == ["density.mlp.init"]
    assert filters.require(frame, "density.init=he")["shading"].tolist() == ["merge"]
    assert capsys.readouterr().err.count("\n") == 2


def test_a_stored_run_is_read_under_today_s_names(tmp_path):
    config = GOLDEN["stored"][0]["config"]
    with RunStore(tmp_path).claim("old-run", config, columns={"gate": "threshold"}).run as run:
        run.finish({"psnr": 20.0})
    assert records.read_config(run.dir) == upgrade_config(config)
    summary = records.read_summary(run.dir)
    assert (summary["shading"], summary["shading.min_share"], summary["density.mlp.width"]) == ("threshold", 0.001, 64)
    assert not any(today(name) != name for name in summary)
    (row,) = index.load(tmp_path).to_dict("records")
    assert (row["shading"], row["encoder.frequency_window"], row["numerics.finite_checks"]) == ("threshold", 0.5, True)


def test_a_table_of_old_and_new_runs_has_the_added_options_of_both(tmp_path):
    for number, config in enumerate((GOLDEN["stored"][0]["config"], composed("seed=1"))):
        with RunStore(tmp_path).claim(f"run-{number}", config).run as run:
            run.finish({"psnr": 20.0})
    frame = load.runs(tmp_path)
    assert frame["color.qfgn.features"].tolist() == [16, 16]
    assert frame["color.qiren.ansatz_options.qiren.axis"].tolist() == ["Z", "Z"]
