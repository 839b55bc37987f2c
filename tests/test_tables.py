import pandas as pd
import pytest

from analysis.load import metrics, runs
from analysis.tables import markdown, over_seeds
from qnerf.experiment import run


@pytest.fixture
def store(tiny, tmp_path):
    for field in ("classical", "qcolor"):
        for seed in (0, 1):
            run(tiny(f"field={field}", f"seed={seed}"))
    return tmp_path / "runs"


def test_means_and_spreads_over_seeds_are_those_of_the_runs(store):
    frame = runs(store)
    assert len(frame) == 4
    assert set(frame["state"]) == {"finished"}
    assert set(frame["scene_name"]) == {"scene"}
    table = over_seeds(frame, ["field", "color"])
    psnr = frame[frame["field"] == "qcolor"]["psnr"]
    row = table.loc[("qcolor", "1L2S")]
    assert row[("psnr", "mean")] == pytest.approx(psnr.mean())
    assert row[("psnr", "std")] == pytest.approx(psnr.std())
    assert row[("seeds", "n")] == 2
    text = markdown(table)
    assert f"| qcolor | 1L2S | {psnr.mean():.2f} ± {psnr.std():.2f} |" in text
    assert "| 491 |" in text

    (path,) = frame[(frame["field"] == "qcolor") & (frame["seed"] == 0)]["path"]
    assert metrics(path, "train/loss")["step"].tolist() == [1, 2]


def test_one_seed_draws_no_spread(store):
    frame = runs(store)
    text = markdown(over_seeds(frame[frame["seed"] == 0], ["field"]))
    assert "±" not in text
    assert text.splitlines()[2].endswith("| 1 |")


def test_mistakes_are_named(store, tmp_path):
    frame = runs(store)
    with pytest.raises(ValueError, match="unknown row key 'colour'; known: "):
        over_seeds(frame, ["colour"])
    with pytest.raises(ValueError, match="holds a seed twice"):
        over_seeds(frame, ["scene"])
    with pytest.raises(ValueError, match="no finished runs among 4"):
        over_seeds(frame.assign(state="failed"), ["field"])
    with pytest.raises(ValueError, match="no runs found"):
        runs(tmp_path / "empty")


def test_unfinished_and_damaged_runs_are_shown_as_such(store):
    frame = runs(store)
    (pd.Series(frame["path"])[0:1]).map(lambda path: open(f"{path}/summary.parquet", "wb").close())
    again = runs(store)
    assert sorted(again["state"].fillna("?")) == ["damaged", "finished", "finished", "finished"]
