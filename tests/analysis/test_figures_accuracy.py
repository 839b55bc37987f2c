"""The figure of the accuracy benchmark draws what the benchmark saved."""

import numpy as np
import pandas as pd
import pytest
from qnerf.analysis import figures


@pytest.fixture
def results():
    """Two parts, one of which has a compiled form; equal bits in float64."""
    rows = [
        ("rendering", "empty ray", "fast", "float32", 1.0, 1e-7, 3e-7, True),
        ("rendering", "empty ray", "plain", "float32", 5.0, 2e-7, 1e-7, False),
        ("rendering", "empty ray", "fast", "float64", 2.0, 0.0, 0.0, True),
        ("rendering", "empty ray", "plain", "float64", 9.0, 0.0, 0.0, False),
        ("sampling", "one spike", "fast", "float32", 0.1, 4e-8, np.nan, True),
    ]
    names = ["part", "case", "variant", "dtype", "ms", "error", "gradient_error", "bounded"]
    return pd.DataFrame(rows, columns=names).assign(bound=2e-6, gradient_bound=[1e-4] * 4 + [np.nan])


def test_the_larger_error_counts_and_the_reference_is_left_out(results):
    table = figures.accuracy_points(results)
    assert table["error"].tolist() == [3e-7, 2e-7, 0, 4e-8]
    assert table["ms"].tolist() == [1, 5, 2, 0.1]
    np.testing.assert_array_equal(table["bound"], [1e-4, np.nan, 1e-4, 2e-6])


def test_each_case_is_a_point_in_the_panel_of_its_part(results):
    rendering, sampling = figures.accuracy_vs_speed(results).axes
    assert [ax.get_title() for ax in (rendering, sampling)] == ["rendering", "sampling"]
    drawn = {line.get_label(): line.get_xydata().tolist() for line in rendering.lines if line.get_ls() == "None"}
    assert drawn == {
        "fast, float32": [[1, 3e-7]],
        "plain, float32": [[5, 2e-7]],
        "fast, float64": [[2, figures.accuracy.FLOOR]],
    }
    dashed = [line.get_ydata()[0] for ax in (rendering, sampling) for line in ax.lines if line.get_ls() == "--"]
    assert dashed == [1e-4, 2e-6]
