import pandas as pd
import pytest

from qnerf.records import filters

FRAME = pd.DataFrame(
    {
        "run_id": ["poster-a-s0", "poster-b-s1", "fox-c-s0"],
        "state": ["finished", "failed", "finished"],
        "psnr": [25.0, None, 21.5],
        "seed": [0, 1, 0],
        "scene.path": [None, None, "/data/fox_64"],
        "flag": [True, False, None],
        "tags": [("good", "base"), (), ("base",)],
        "train.lr": [0.01, 0.01, 0.001],
    }
)


@pytest.mark.parametrize(
    ("conditions", "rows"),
    [
        ([], [0, 1, 2]),
        (["poster"], [0, 1]),
        (["poster", "s0"], [0]),
        (["state=finished"], [0, 2]),
        (["state=failed,running"], [1]),
        (["state!=finished"], [1]),
        (["psnr>22"], [0]),
        (["psnr>=21.5"], [0, 2]),
        (["psnr<25"], [2]),
        (["psnr=none"], [1]),
        (["seed=0", "psnr<22"], [2]),
        (["train.lr=1e-2"], [0, 1]),
        (["scene.path=*fox*"], [2]),
        (["scene.path!=none"], [2]),
        (["tag=good"], [0]),
        (["tags=base"], [0, 2]),
        (["tag=none"], [1]),
        (["tag!=base"], [1]),
        (["flag=true"], [0]),
        (["flag=none"], [2]),
        (["id=fox-*"], [2]),
    ],
)
def test_rows_that_meet_every_condition(conditions, rows):
    assert filters.select(FRAME, filters.parse(conditions)).index.tolist() == rows


def test_a_comparison_needs_a_number():
    with pytest.raises(ValueError, match="psnr>high: > compares numbers, got 'high'"):
        filters.parse(["psnr>high"])


@pytest.mark.parametrize(("name", "near"), [("psn", "psnr"), ("lr", r"train\.lr"), ("stat", "state")])
def test_an_unknown_column_names_the_nearest(name, near):
    with pytest.raises(ValueError, match=f"no run has a column '{name}'; did you mean {near}"):
        filters.select(FRAME, filters.parse([f"{name}=1"]))


def test_no_runs_match_nothing():
    assert filters.select(FRAME.head(0), filters.parse(["state=finished"])).empty
