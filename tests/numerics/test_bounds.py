"""Every case of the accuracy benchmark within its bounds."""

import math

import pandas as pd

from benchmarks.accuracy import beyond, measure, page, relative
from benchmarks.accuracy_cases import every, rounded
from tests.helpers.hard_inputs import held

CASES = every()


def test_cases_have_names_of_their_own() -> None:
    assert len({case.id for case in CASES}) == len(CASES)


def test_hard_cases() -> None:
    for case in CASES:
        for tensor in case.inputs:
            assert not tensor.is_floating_point() or (rounded(tensor) == tensor).all(), case.id
        held(case)


def test_relative_error_is_infinite_where_a_nan_hides() -> None:
    exact = rounded([1.0, -4.0, math.inf])
    assert relative(rounded([1.5, -4.0, math.inf]), exact) == 0.125
    for wrong in ([1.0, -4.0, 5.0], [1.0, math.nan, math.inf], [1.0, -4.0, -math.inf]):
        assert relative(rounded(wrong), exact) == math.inf
    assert relative(rounded([math.nan]), rounded([math.nan])) == 0


def test_page_shows_the_largest_errors_and_broken_bounds_are_found() -> None:
    case = next(case for case in CASES if case.id == "losses: distortion, coincident edges")
    frame = pd.DataFrame(measure(case, repeats=1))
    assert beyond(frame).empty
    text = page(frame, ["Regularisers.\n\nWhat to know."])
    (line,) = (line for line in text.splitlines() if line.startswith("| losses |"))
    shown = [cell.strip() for cell in line.split("|")[2:-1]]
    fast, plain = (
        frame[(frame["variant"] == name) & (frame["dtype"] == "float32")].iloc[0] for name in ("fast", "plain")
    )
    assert shown[0] == f"{fast['error']:.1e}"
    assert shown[2] == f"{fast['gradient_error']:.1e}"
    assert shown[4] == f"{plain['error']:.1e}"
    assert text.endswith("## Limits\n\nWhat to know.\n")
    broken = frame.assign(error=frame["error"] + 1)
    assert set(beyond(broken)["variant"]) == {"fast"}
