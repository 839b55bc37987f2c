"""Choosing runs by a query: what it chooses, what it tells, and that it can do nothing else."""

import builtins
import os

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
        ("field == 'qcolor'", "bc"),
        ("field != 'qcolor'", "ad"),
        ("field == 'qcolor' and qiren.layers > 2", "c"),
        ("`qiren.layers` > 1 & seed < 2", "b"),
        ("`two words` == 2", "cd"),
        ("seed in [0, 3] or psnr > 24", "acd"),
        ("field not in ('qcolor',)", "ad"),
        ("not 20 <= psnr < 25", "cd"),
        ("~(psnr > 20)", "ad"),
        ("run.force", "b"),
        ("run.force == False and -1 < seed", "acd"),
        ("mixed == 'auto'", "b"),
        ("field == '`seed`' or seed == 0", "a"),
        ('field == "qcolor" and (seed == 1 or seed == 2)', "bc"),
        ("psnr > seed", "abc"),
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
        ("field == 'qboth'", "none of 4 runs has field == 'qboth'; there are field: classical, qcolor"),
        ("psnr > 30 and seed == 1", "psnr: 20.0, 21.5, 25.0; seed: 0, 1, 2, 3"),
        ({"field": "qboth", "seed": 1}, "has field=qboth, seed=1; there are field: classical, qcolor; seed: 0, 1"),
        ({"seed": []}, r"none of 4 runs has seed=\[\]"),
        ({"tags": "bad"}, "tags: good, old"),
        ("fild == 'a'", "no run has a column 'fild'; near ones: field"),
        ("layers == 1", "no run has a column 'layers'; near ones: qiren.layers"),
        ({"qiren.layer": 1}, "no run has a column 'qiren.layer'; near ones: qiren.layers"),
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


HOSTILE = [
    "__import__('os').system('touch {}')",
    "@__import__('os').system('touch {}')",
    "@pd.io.common.os.system('touch {}')",
    "run_id.to_csv('{}')",
    "run_id.map(open)",
    "`run_id`.to_csv('{}')",
    "run_id.str.cat()",
    "field.__class__.__mro__ == 1",
    "`field`.__class__ == 1",
    "_quoted[0] == 1",
    "`seed`[0] == 1",
    "seed[__import__('os').system('touch {}')] == 1",
    "[seed for seed in [1]]",
    "(lambda: open('{}', 'w'))() == 1",
    "open('{}', 'w')",
    "seed == (x := 1)",
    "f'{{seed}}' == '1'",
    "seed ** 99999 == 1",
    "'a' * 10000000000 == 'a'",
    "seed == 1; seed == 2",
    "seed = 1",
    "import os",
    "seed == 1 if True else False",
    "seed == None",
    "seed == b'1'",
    "seed == 1j",
    "seed == ...",
    "seed is True",
    "*seed",
    "seed == {{1: 2}}",
    "seed",
    "1 == 1",
    "",
    "   ",
    "seed == '",
    "`seed == 1",
    "seed == 1\0",
    "(" * 500 + "seed" + ")" * 500 + " == 1",
    "not " * 450 + "run.force",
    "-" * 1500 + "seed == 1",
    "seed == 1 or " * 500 + "seed == 1",
]


@pytest.mark.parametrize("text", HOSTILE, ids=range(len(HOSTILE)))
def test_a_query_can_only_choose(text: str, tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    def called(*arguments: object, **options: object) -> None:
        pytest.fail("the query did something")

    target = tmp_path / "written"
    monkeypatch.setattr(os, "system", called)
    monkeypatch.setattr(builtins, "eval", called)
    monkeypatch.setattr(builtins, "exec", called)
    with pytest.raises(ValueError, match=r"is no query: |no run has a column ") as error:
        select(FRAME, text.format(target) if "{}" in text else text.replace("{{", "{").replace("}}", "}"))
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 600
    assert not target.exists()
