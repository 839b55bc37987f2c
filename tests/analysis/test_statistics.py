import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from qnerf.analysis.load import runs
from qnerf.analysis.statistics import difference, evaluations, holm, paired, stars
from scipy import stats

from benchmarks import coverage
from tests.helpers.packed_stores import write_run

DIFFERENCES = arrays(float, st.tuples(st.integers(1, 5), st.integers(1, 8)), elements=st.floats(-30, 30, width=32))


@given(DIFFERENCES)
def test_the_interval_holds_the_mean_difference(differences):
    found = difference(differences)
    assert found.mean == pytest.approx(differences.mean())
    assert found.low <= found.mean <= found.high
    assert (found.seeds, found.views) == differences.shape
    assert 0 < found.p <= 1


@given(DIFFERENCES, st.floats(-50, 50))
def test_a_shift_shifts_the_interval(differences, shift):
    one, other = difference(differences), difference(differences + shift)
    assert [other.low, other.high] == pytest.approx([one.low + shift, one.high + shift], abs=1e-6)


@given(DIFFERENCES.filter(lambda differences: abs(differences.mean()) > 1e-3 and differences.size > 1))
def test_the_interval_of_level_one_minus_p_ends_at_zero(differences):
    p = difference(differences).p
    if p > 1e-9:
        found = difference(differences, level=1 - p)
        assert min(abs(found.low), abs(found.high)) <= 1e-5 * abs(found.mean)


def test_one_view_or_one_seed_is_students_interval():
    values = np.random.default_rng(0).normal(size=7)
    expected = stats.t.interval(0.95, 6, values.mean(), stats.sem(values))
    for differences in (values[None], values[:, None]):
        found = difference(differences)
        assert (found.low, found.high) == pytest.approx(expected)
        assert found.p == pytest.approx(stats.ttest_1samp(values, 0).pvalue)
    assert difference(values[:, None]).effect == pytest.approx(values.mean() / values.std(ddof=1))
    assert np.isnan(difference(values[None]).effect)
    assert difference(values[None, :1]).low == -np.inf


@pytest.mark.parametrize("seeds", [3, 10])
def test_95_percent_of_intervals_hold_the_truth_however_hard_the_views_are(seeds):
    random = np.random.default_rng(3)
    hits = 0
    for _ in range(1000):
        differences = 0.3 * random.normal(size=(seeds, 1)) + 0.3 * random.normal(size=(1, 5))
        found = difference(differences + 0.5 * random.normal(size=(seeds, 5)))
        hits += found.low <= 0 <= found.high
    assert 930 <= hits <= 985  # seeds alone, without the views, give 827 for 10


@pytest.mark.parametrize("kind", ["normal", "measured"])
def test_the_coverage_benchmark_draws_what_was_measured(kind):
    random = np.random.default_rng(0)
    parts = random.normal(size=(12, 1)), 0.5 * random.normal(size=(1, 12)), 0.3 * random.normal(size=(12, 12))
    found = coverage.effects("poster", 7 + sum(parts))
    assert found.spread == pytest.approx((parts[0].std(ddof=1), parts[1].std(ddof=1), 0.3), rel=0.1)
    again = coverage.effects("poster", found.draw(4000, kind, random))
    assert again.spread[0] == pytest.approx(found.spread[0], rel=0.05)
    assert again.spread[2] == pytest.approx(found.spread[2], rel=0.05)


def test_no_pairs_give_no_interval():
    assert difference(np.empty((0, 4))) is None
    assert difference(np.empty((3, 0))) is None


@given(st.lists(st.floats(1e-12, 1), min_size=1, max_size=8))
def test_holm_is_at_least_as_strict_as_one_comparison_and_no_stricter_than_bonferroni(p):
    adjusted = holm(p)
    assert (adjusted >= p).all()
    assert (adjusted <= np.minimum(1, len(p) * np.asarray(p))).all()
    assert adjusted[np.argmin(p)] == min(1, len(p) * min(p))
    assert (np.diff(adjusted[np.argsort(p)]) >= 0).all()


def test_stars_need_five_seeds_and_holm():
    nothing = float("nan")
    # 0.02 stands alone; beside 0.03 and without the row of 3 seeds it is doubled, and still below 0.05.
    assert stars([0.02, 0.03, 1e-9, nothing], [5, 5, 3, nothing]).tolist() == [True, True, False, False]
    assert stars([0.03, 0.03], [5, 5]).tolist() == [False, False]


def test_pairs_are_of_the_same_seed_and_view(tmp_path):
    write_run(tmp_path, "classical", 0, [20.0, 21.0, 22.0])
    write_run(tmp_path, "classical", 1, [10.0, 11.0])
    write_run(tmp_path, "classical", 2, [0.0, 0.0])
    write_run(tmp_path, "qcolor", 1, [11.0, 14.0, 17.0])
    write_run(tmp_path, "qcolor", 0, [22.0, 21.0, float("nan")])
    frame = runs(tmp_path)
    views = evaluations(frame)
    assert len(views) == 13
    path = frame.set_index("path")["field"]
    one, two = (views[views["path"].map(path) == field] for field in ("classical", "qcolor"))
    # Seed 2 is one's alone; view 2 is missing for seed 1 of the first and NaN for seed 0 of the second.
    assert paired(one, two).tolist() == [[2, 0], [1, 3]]


def test_a_run_without_readable_views_has_no_rows(tmp_path):
    kept, damaged, absent = (write_run(tmp_path, "classical", seed) for seed in range(3))
    (damaged / "eval.parquet").write_bytes(b"PAR1")
    (absent / "eval.parquet").unlink()
    assert set(evaluations(runs(tmp_path))["path"]) == {str(kept)}
    assert evaluations(pd.DataFrame({"path": [], "seed": []})).empty
    with pytest.raises(ValueError, match="step_ms is not measured for each view; such metrics are psnr"):
        evaluations(runs(tmp_path), "step_ms")
