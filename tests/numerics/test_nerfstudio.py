"""Our functions against the stored results of nerfstudio 1.1.5 for the same inputs."""

import pandas as pd
import pytest

from benchmarks.nerfstudio_functions import BOUND, DIFFERENT, STORED, differences


@pytest.fixture(scope="module")
def rows() -> pd.DataFrame:
    return differences().set_index("function")


def test_every_function_agrees_within_its_bound(rows: pd.DataFrame) -> None:
    beyond = rows[~(rows["difference"] <= rows["bound"])]
    assert beyond.empty, beyond.to_string()
    assert len(rows) == 37


@pytest.mark.parametrize("name", DIFFERENT)
def test_where_more_than_rounding_differs_ours_is_nearer_to_float64(rows: pd.DataFrame, name: str) -> None:
    row = rows.loc[name]
    assert row["difference"] > BOUND
    assert row["ours"] < row["theirs"]


def test_the_stored_file_is_small() -> None:
    assert STORED.stat().st_size < 150_000
