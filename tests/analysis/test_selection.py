import pandas as pd
import pytest
from qnerf.analysis.selection import check_keys, classical_baseline, measured, select, settings

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


def test_selection_names_unknown_columns_and_metrics_that_no_run_has():
    with pytest.raises(ValueError, match="no run has a column 'feild'; did you mean field"):
        check_keys(FRAME, ["feild"])
    with pytest.raises(ValueError, match=r"no finished run of 2 has lpips \(no weights\); have: psnr"):
        select(FRAME, "lpips")


def test_settings_are_not_what_is_measured():
    assert measured(FRAME) == ["psnr"]


def test_selection_tells_everything_left_out():
    assert select(FRAME).note == "left out: 1 running"
    assert select(FRAME[:2]).note == ""
    gone = FRAME[:2].assign(explained=[0.9, -0.1])
    assert select(gone).note == "colourless (explained variance below 0.25): 1"


def test_runs_of_a_search_are_in_no_table_with_others():
    searched = FRAME[:2].assign(**{"scene.validation": [0.1, None]})
    made = select(searched)
    assert (list(made.runs["psnr"]), made.note) == ([21.0], "left out: 1 of a search")
    assert select(searched[:1]).note == "all of a search: no test views"


def test_an_option_that_does_not_act_in_a_run_is_no_setting_of_it():
    """An absent column means that: the runs of a signal beside the runs of a field."""
    base = {"state": "finished", "seed": 0, "psnr": 20.0, "train.steps": 10}
    rows = [base | {"field": "classical", "color.mlp.width": 64.0}, base | {"head": "1L2S", "head.qiren.layers": 1.0}]
    made = settings(pd.DataFrame(rows))
    assert made.to_dict("records") == [
        {"color.mlp.width": "64", "head.qiren.layers": ""},
        {"color.mlp.width": "", "head.qiren.layers": "1"},
    ]


def test_the_baseline_of_an_equal_time_study_is_what_was_trained_most():
    runs = pd.DataFrame(
        {"scene_name": "fox", "field": ["classical"] * 4 + ["qcolor"] * 3, "train.steps": [100] + [200] * 6}
    )
    rows = ["scene_name", "field", "train.steps"]
    assert classical_baseline(runs, rows) == {"field": "classical", "train.steps": [200]}
    assert classical_baseline(runs[1:], rows[:2]) == {"field": "classical"}
    colored = runs.assign(color=["2x64", "3x64", *["3x64"] * 5])
    expected = {"field": "classical", "color": "3x64", "train.steps": [200]}
    assert classical_baseline(colored, [*rows, "color"]) == expected
    with pytest.raises(ValueError, match="there is no classical field: give --baseline, such as field=qcolor"):
        classical_baseline(runs[4:], rows)
