"""Choosing runs: what is chosen, and what is told when nothing is."""

import numpy as np
import pandas as pd
import pytest

from analysis.query import known, select

FRAME = pd.DataFrame(
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
        "tags": [(), ("good",), ("good", "old"), ()],
    }
)


@pytest.mark.parametrize(
    ("condition", "chosen"),
    [
        ("field=qcolor", "bc"),
        ("field!=qcolor", "ad"),
        ("field=qcolor qiren.layers>2", "c"),
        ("'two words=2'", "cd"),
        ("seed=0,3", "ad"),
        ("field=none", "d"),
        ("psnr>=20 'psnr<25'", "ab"),
        ("run.force=true", "b"),
        ("mixed=auto", "b"),
        ("tag=good", "bc"),
        ("field=q* seed=1", "b"),
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
        ({"tags": "good"}, "bc"),
        ({"tags": ["old", "new"]}, "c"),
    ],
)  # fmt: skip
def test_what_is_chosen(condition: str | dict, chosen: str) -> None:
    assert "".join(select(FRAME, condition)["run_id"]) == chosen


@pytest.mark.parametrize(
    ("condition", "told"),
    [
        ("field=qboth", "none of 4 runs has field=qboth; there are field: classical, qcolor"),
        ("psnr>30 seed=1", "psnr: 20.0, 21.5, 25.0; seed: 0, 1, 2, 3"),
        ({"field": "qboth", "seed": 1}, "has field=qboth, seed=1; there are field: classical, qcolor; seed: 0, 1"),
        ({"seed": []}, r"none of 4 runs has seed=\[\]"),
        ({"tags": "bad"}, "tags: good, old"),
        ("fild=a", "no run has a column 'fild'; did you mean field"),
        ("layers=1", "no run has a column 'layers'; did you mean qiren.layers"),
        ({"qiren.layer": 1}, "no run has a column 'qiren.layer'; did you mean qiren.layers"),
        ("psnr>high", "filter 'psnr>high': psnr>high: > compares numbers, got 'high'"),
        ("field='qcolor", "filter .*: No closing quotation"),
    ],
)  # fmt: skip
def test_what_is_told_when_nothing_is_chosen(condition: str | dict, told: str) -> None:
    with pytest.raises(ValueError, match=told) as error:
        select(FRAME, condition)
    assert "\n" not in str(error.value)


def test_many_values_are_told_in_short() -> None:
    assert known(pd.Series(range(100), name="x")) == "0 to 99"
    assert known(pd.Series([f"v{i:02d}" for i in range(12)], name="x"), 3) == "v00, v01, v02 and 9 more"
    assert known(pd.Series([None, np.nan], name="x", dtype=object)) == "no values"
