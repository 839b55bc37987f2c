"""Choosing runs: what is chosen, and what the message says when nothing is."""

import numpy as np
import pandas as pd
import pytest

from qnerf.records import filters

RUNS = pd.DataFrame(
    {
        "run_id": ["a", "b", "c", "d"],
        "field": ["classical", "qcolor", "qcolor", None],
        "seed": [0, 1, 2, 3],
        "qiren.layers": [1, 2, 3, 1],
        "two words": [1, 1, 2, 2],
        "psnr": [20.0, 21.5, 25.0, np.nan],
        "run.force": [False, True, False, False],
        "mixed": ["1", "auto", "true", None],
        "flag": pd.Series([True, None, False, None], dtype=object),
        "samples": ["[128, 64]", "[64, 32]", None, None],
        "scene.path": [None, None, "/data/fox_64", None],
    }
)


def test_a_filter_chooses_runs():
    for condition, chosen in (
        ("field=qcolor", "bc"),
        ("field!=qcolor", "ad"),
        ("field=qcolor qiren.layers>2", "c"),
        ("'two words=2'", "cd"),
        ("seed=0,3", "ad"),
        ("field=none", "d"),
        ("psnr>=20 'psnr<25'", "ab"),
        ("run.force=true", "b"),
        ("mixed=auto", "b"),
        ("field=q* seed=1", "b"),
        ("b", "b"),
        ("id=b,c", "bc"),
        ("psnr>=21.5", "bc"),
        ("psnr=none", "d"),
        ("flag=none", "bd"),
        ("scene.path=*fox*", "c"),
        ("samples=[128,64],[64,32]", "ab"),
        ("samples=[64,32],seed=1", "b"),
        ({}, "abcd"),
        ({"field": "qcolor"}, "bc"),
        ({"field": "qcolor", "seed": [0, 1]}, "b"),
        ({"field": None}, "d"),
        ({"psnr": [None, 25]}, "cd"),
        ({"seed": range(2)}, "ab"),
        ({"run.force": True}, "b"),
        ({"flag": False}, "c"),
        ({"mixed": 1}, "a"),
        ({"mixed": True}, "c"),
    ):  # fmt: skip
        assert "".join(filters.require(RUNS, condition)["run_id"]) == chosen, condition


def test_columns_have_one_list_of_names():
    frame = pd.DataFrame({"scene_name": ["a", "b"], "color": ["x", "y"], "color.mlp.width": [1, 2]})
    for condition in ("scene=b", "scene_name=b", "color=y", "colour=y", "color.mlp.width=2", "colour.mlp.width=2"):
        assert filters.require(frame, condition)["scene_name"].tolist() == ["b"], condition
    assert filters.column(" scene.name ") == "scene.name"


def test_a_filter_that_chooses_nothing_says_why():
    for condition, told in (
        ("field=qboth", "no run of 4 has field=qboth; there are field: classical, qcolor"),
        ("psnr>30 seed=1", "psnr: 20, 21.5, 25; seed: 0, 1, 2, 3"),
        ({"field": "qboth", "seed": 1}, "has field=qboth, seed=1; there are field: classical, qcolor; seed: 0, 1"),
        ({"seed": []}, r"no run of 4 has seed=\[\]"),
        ("fild=a", "no run has a column 'fild'; did you mean field"),
        ("layers=1", "no run has a column 'layers'; did you mean qiren.layers"),
        ({"qiren.layer": 1}, "no run has a column 'qiren.layer'; did you mean qiren.layers"),
        ("psnr>high", "filter 'psnr>high': psnr>high: > compares numbers, got 'high'"),
        ("field='qcolor", "filter .*: No closing quotation"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=told) as error:
            filters.require(RUNS, condition)
        assert "\n" not in str(error.value)


def test_many_values_are_told_in_short():
    assert filters.known_values(pd.Series(range(100), name="x")) == "0 to 99"
    assert filters.known_values(pd.Series([f"v{i:02d}" for i in range(12)], name="x"), 3) == "v00, v01, v02 and 9 more"
    assert filters.known_values(pd.Series([None, np.nan], name="x", dtype=object)) == "no values"


def test_integers_beyond_what_floats_hold_are_told_apart():
    frame = pd.DataFrame({"run_id": ["a", "b"], "seed": [2**53, 2**53 + 1]})
    assert filters.select(frame, filters.parse(["seed=9007199254740993"]))["run_id"].tolist() == ["b"]
    assert filters.select(frame, filters.parse(["seed=9007199254740992.0"]))["run_id"].tolist() == ["a", "b"]
