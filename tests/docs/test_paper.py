"""The paper's tables with our runs beside them."""

import pytest
from qnerf.analysis.load import runs

from docs.tools.paper.__main__ import main
from docs.tools.paper.joined import printed
from docs.tools.paper.tables import PAPER_TABLES, rgb_predictors
from tests.helpers.packed_stores import write_run


@pytest.fixture
def store(tmp_path):
    for seed, level in enumerate((24.0, 26.0)):
        write_run(tmp_path, "qcolor", seed, [level])
        write_run(tmp_path, "classical", seed, [level + 1])
    damaged = write_run(tmp_path, "qcolor", 9)
    (damaged / "summary.parquet").write_bytes(b"")
    return tmp_path


def test_ours_join_through_architecture_and_count(store):
    table = rgb_predictors(runs(store))
    text = table.text.set_index("colour head")
    assert len(text) == 23
    assert text.loc["1L2S", ["PSNR, dB: paper", "PSNR, dB: ours", "seeds"]].tolist() == ["30.74", "25.00 ± 1.41", "2"]
    # The row printed as 3 x 32 is the 3 x 64 network of 5,763 parameters.
    row = text.loc["3x64"]
    assert row[["printed as", "colour parameters", "PSNR, dB: paper"]].tolist() == ["3x32", "5,763", "31.12"]
    assert row[["PSNR, dB: ours", "seeds"]].tolist() == ["26.00 ± 1.41", "2"]
    assert "left out: 1 damaged" in table.notes
    assert text.drop(["1L2S", "3x64"])["seeds"].unique().tolist() == ["0"]
    assert text.drop(["1L2S", "3x64"])["PSNR, dB: ours"].unique().tolist() == [""]


def test_errata_are_shown(store):
    table = rgb_predictors(runs(store))
    assert (table.text["printed as"] != "").sum() == 6
    assert "errata: 8x12 is printed 3 times, with 14.52 dB and 16.36 dB and 14.52 dB" in table.notes
    both = PAPER_TABLES["both"][1](runs(store))
    assert both.text.loc[both.text["printed as"] != "", "printed as"].tolist() == [
        "3L1S 1L1S",
        "4L1S 3L1S",
        "5L1S 4L1S",
        "4L4S 3L4S",
    ]


def test_a_run_of_another_count_is_not_the_papers_architecture(store):
    write_run(store, "qcolor", 7, columns={"color": "1L1S", "params.color": 400})
    table = rgb_predictors(runs(store))
    assert table.text.set_index("colour head").loc["1L1S", "seeds"] == "0"
    assert "1 finished runs have an architecture that is not in this table" in table.notes


def test_runs_under_different_settings_are_not_averaged(store):
    write_run(store, "qcolor", 2, config={"train": {"steps": 99}})
    with pytest.raises(ValueError, match=r"mixes runs of different train.steps \(10, 99\)"):
        rgb_predictors(runs(store))


@pytest.mark.parametrize("key", PAPER_TABLES)
def test_every_table_of_the_paper_draws_without_a_run_of_its_own(store, key, capsys):
    title, function = PAPER_TABLES[key]
    frame = runs(store)
    table = function(frame.assign(field="other"))
    assert table.title == title
    assert table.text["seeds"].unique().tolist() == ["0"]
    assert len(table.text) == len(printed(key))
    main([key, str(store), "--format", "latex"])
    assert r"\bottomrule" in capsys.readouterr().out


def test_hash_tables_stand_beside_our_counts(store):
    text = PAPER_TABLES["hash"][1](runs(store)).text.set_index("hash table")
    assert text.loc["C5", ["encoder parameters", "PSNR, dB: ours", "seeds"]].tolist() == [
        "393,216",
        "26.00 ± 1.41",
        "2",
    ]
