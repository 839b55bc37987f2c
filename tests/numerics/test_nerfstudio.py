"""Our functions against the stored results of nerfstudio 1.1.5 for the same inputs."""

import pandas as pd
import pytest

from tests.numerics.nerfstudio_functions import BOUND, DIFFERENT, differences


@pytest.fixture(scope="module")
def rows() -> pd.DataFrame:
    return differences().set_index("function")


def test_functions_agree_with_nerfstudio_within_their_bounds(rows: pd.DataFrame) -> None:
    beyond = rows[~(rows["difference"] <= rows["bound"])]
    assert beyond.empty, beyond.to_string()
    assert len(rows) == 37


def test_functions_that_differ_are_nearer_to_float64(rows: pd.DataFrame) -> None:
    for name in DIFFERENT:
        row = rows.loc[name]
        assert row["difference"] > BOUND, name
        assert row["ours"] < row["theirs"], name
