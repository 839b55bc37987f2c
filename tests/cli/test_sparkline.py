import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from qnerf.cli.sparkline import BLOCKS, sparkline


@pytest.mark.parametrize(
    ("values", "width", "drawn"),
    [
        (range(8), 8, BLOCKS),
        (range(16), 8, BLOCKS),
        ([1, 1, 1], 10, "▁▁▁"),
        ([0, math.nan, 7], 3, "▁ █"),
        ([math.nan], 5, " "),
        ([0, math.inf, -math.inf, 1], 4, "▁  █"),
        ([], 5, ""),
    ],
)
def test_a_curve_as_text(values, width, drawn):
    assert sparkline(list(values), width) == drawn


@given(values=st.lists(st.floats()), width=st.integers(1, 40))
def test_it_is_never_wider_than_asked(values, width):
    drawn = sparkline(values, width)
    assert len(drawn) == min(width, len(values))
    assert set(drawn) <= {*BLOCKS, " "}
