import pandas as pd
import pytest
from qnerf.analysis.selection import check_keys, measured, select

from qnerf.records import filters

FRAME = pd.DataFrame(
    {
        "state": ["finished", "finished", "running"],
        "field": ["classical", "qcolor", "qcolor"],
        "experiment": [None, "no_gain", None],
        "encoder.dense": [True, False, True],
        "train.lr": [0.01, 0.001, 0.01],
        "color.qiren.gain": [None, 10.0, "auto"],
        "psnr": [20.0, 21.0, None],
        "lpips": [None, None, None],
        "lpips_reason": ["no weights"] * 3,
        "seed": [0, 1, 2],
    }
).astype({"lpips": float})


@pytest.mark.parametrize(
    ("text", "seeds"),
    [
        ("field=qcolor", [1, 2]),
        ("field=qcolor,experiment=none", [2]),
        ("encoder.dense=true", [0, 2]),
        ("train.lr=1e-2", [0, 2]),
        ("seed=1", [1]),
        ("color.qiren.gain=10.0", [1]),
        ("color.qiren.gain=10", [1]),
    ],
)
def test_conditions_choose_by_value(text, seeds):
    assert filters.require(FRAME, text)["seed"].tolist() == seeds


def test_mistakes_are_named():
    for message, call in {
        "no run has a column 'feild'; did you mean field": lambda: check_keys(FRAME, ["feild"]),
        "none of 3 rows has train.lr=small; there are train.lr: 0.001, 0.01": lambda: filters.require(
            FRAME, {"train.lr": "small"}, "rows"
        ),
        r"none of 2 finished runs has lpips \(no weights\); have: psnr": lambda: select(FRAME, "lpips"),
    }.items():
        with pytest.raises(ValueError, match=message):
            call()


def test_what_is_measured_is_no_setting():
    assert measured(FRAME) == ["psnr"]


def test_everything_left_out_is_told():
    assert select(FRAME).note == "left out: 1 running"
    assert select(FRAME[:2]).note == ""


def test_a_run_that_differs_in_nothing_that_acts_counts_once():
    """An MLP does not see the circuits' options, nor a circuit the MLP's width; another seed is another run."""
    base = {"state": "finished", "field": "classical", "qiren": "1L2S", "color.qiren.layers": 1, "color.mlp.width": 64}
    rows = [
        base | {"seed": 0, "psnr": 20.0},
        base | {"seed": 0, "psnr": 20.0, "qiren": "3L2S", "color.qiren.layers": 3},
        base | {"seed": 1, "psnr": 21.0},
        base | {"seed": 0, "psnr": 22.0, "color.mlp.width": 32},
        base | {"seed": 0, "psnr": 23.0, "field": "qcolor"},
        base | {"seed": 0, "psnr": 23.0, "field": "qcolor", "color.mlp.width": 32},
    ]
    selection = select(pd.DataFrame(rows))
    assert selection.note == "left out: 2 repeating another"
    assert selection.runs["psnr"].tolist() == [20.0, 21.0, 22.0, 23.0]
    assert selection.runs["qiren"].fillna("none").tolist() == ["none", "none", "none", "1L2S"]
    assert selection.runs["color.mlp.width"].astype(float).fillna(0).tolist() == [64, 64, 32, 0]


def test_options_that_heads_copy_are_columns_too():
    """`qiren.layers` is what a user sweeps; it acts through `color.qiren.layers`."""
    base = {"state": "finished", "seed": 0, "encoder": "hash", "psnr": 20.0}
    rows = [
        base | {"field": "classical", "qiren.layers": 1, "hash.levels": 8},
        base | {"field": "classical", "qiren.layers": 2, "hash.levels": 8},
        base | {"field": "qcolor", "qiren.layers": 1, "color.qiren.layers": 1, "hash.levels": 8},
        base | {"field": "qcolor", "qiren.layers": 2, "color.qiren.layers": 2, "hash.levels": 8, "encoder": "pe"},
    ]
    runs = select(pd.DataFrame(rows)).runs
    assert runs["qiren.layers"].astype(float).fillna(0).tolist() == [0, 1, 2]
    assert runs["hash.levels"].astype(float).fillna(0).tolist() == [8, 8, 0]
