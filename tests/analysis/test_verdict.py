import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from qnerf.analysis.load import runs
from qnerf.analysis.verdict import compare, evaluations, judge, over_scenes, verdict, within_of, yuen
from scipy import stats

from tests.helpers.packed_stores import write_run

GROUP = st.lists(st.floats(10, 40, width=32), min_size=2, max_size=5, unique=True)
LARGE = st.lists(st.floats(10, 40, width=32), min_size=6, max_size=21, unique=True)


@given(GROUP, GROUP, st.sampled_from([0.05, 0.01]))
def test_small_groups_are_compared_by_welchs_test(one, two, alpha):
    difference, error, freedom = yuen(one, two)
    expected = stats.ttest_ind(two, one, equal_var=False)
    interval = expected.confidence_interval(1 - alpha)
    found = judge(difference, error, freedom, 0.5, alpha=alpha)
    assert (difference - found.reach, difference + found.reach) == pytest.approx(tuple(interval), rel=1e-6, abs=1e-9)
    assert freedom == pytest.approx(expected.df)


@given(LARGE, LARGE)
def test_larger_groups_are_compared_by_yuens_test(one, two):
    difference, error, freedom = yuen(one, two)
    expected = stats.ttest_ind(two, one, equal_var=False, trim=0.2)
    assert (difference / error, freedom) == pytest.approx((expected.statistic, expected.df), rel=1e-6)


@given(GROUP, GROUP, st.floats(0.1, 20), st.sampled_from([1, -1]))
def test_a_verdict_is_that_of_scipys_tests(one, two, within, sign):
    """Equivalence is two one-sided tests, a difference is one two-sided test, each at 5 %."""
    found = judge(*yuen(one, two), within, sign=sign)
    shifted = [
        stats.ttest_ind(np.add(two, within), one, equal_var=False, alternative="greater").pvalue,
        stats.ttest_ind(np.subtract(two, within), one, equal_var=False, alternative="less").pvalue,
    ]
    above, below = (p < 0.05 for p in shifted)
    differs = stats.ttest_ind(two, one, equal_var=False).pvalue < 0.05
    if above and below:
        assert found.kind == "equivalent"
        assert bool(found.excluded) == differs
    elif differs:
        assert found.kind == ("better" if sign * found.difference > 0 else "worse")
    else:
        assert found.kind == "undecided"
        no_loss, no_gain = (above, below) if sign > 0 else (below, above)
        assert found.excluded == ("a loss" if no_loss else "a gain" if no_gain else "")


def test_a_verdict_is_a_sentence():
    assert judge(0.1, 0.1, 18, 0.5).text() == "equivalent"
    assert judge(0.3, 0.1, 18, 0.5).text() == "equivalent, above 0"
    assert judge(-1.2, 0.2, 18, 0.5).text() == "worse"
    assert judge(-1.2, 0.2, 18, 0.5, sign=-1).text() == "better"
    assert judge(0.4, 0.3, 18, 0.5).text() == "undecided: a loss of 0.5 dB is ruled out"
    assert judge(-0.4, 0.3, 18, 0.5).text() == "undecided: a gain of 0.5 dB is ruled out"
    assert judge(0.1, 0.5, 18, 0.5).text("ssim") == "undecided"


def test_verdict_of_one_run_is_undecided():
    found = verdict([20.0], [30.0, 31.0], 0.5)
    assert (found.kind, found.excluded, found.reach, found.star) == ("undecided", "", np.inf, False)
    assert verdict([], [30.0, 31.0], 0.5).kind == "undecided"


def test_runs_without_any_spread_are_decided():
    """Scaling errors of rounding are no spread."""
    assert verdict([20.1] * 3, [0.1 + 20.0] * 3, 0.5).kind == "equivalent"
    assert verdict([20.0] * 2, [21.0] * 2, 0.5).kind == "better"


def test_a_star_holds_for_all_rows_together():
    one, two = [20.0, 20.4, 19.8, 20.2], [21.0, 20.6, 20.9, 20.3]
    assert stats.ttest_ind(one, two, equal_var=False).pvalue == pytest.approx(0.027, abs=1e-3)
    assert [verdict(one, two, 0.1, comparisons=m).star for m in (1, 2)] == [True, False]


def test_a_slip_is_counted_and_does_not_decide():
    good = [24.0, 24.1, 23.9, 24.2, 24.0, 24.1, 24.2]
    found = verdict(good, [*good, 24.0, 9.0, np.nan], 0.5)
    assert (found.seeds, found.slipped, found.kind) == ((7, 10), (0, 2), "equivalent")
    assert found.text() == "equivalent; slipped 2 of 10"
    assert verdict(good, [*good[:2], *[9.0] * 5], 0.5).kind == "worse"  # the typical run itself
    assert verdict(good[:1], [np.nan, np.nan], 0.5).slipped == (0, 2)
    for few in ([25.0, 25.1] + [np.nan] * 4, [25.0, 25.1, np.nan]):  # more than are trimmed: the rest is no typical run
        assert verdict(good, few, 0.5).kind == "undecided"
    low = verdict(good, [*good[:5], np.nan], 0.5)
    assert low.difference == verdict(good, [*good[:5], -50.0], 0.5).difference  # the worst run, not one that is absent
    assert verdict([0.1, 0.2], [0.1, 9.0], 0.1, metric="distance_error").slipped == (0, 0)  # no dB


def test_both_sides_are_trimmed_or_none():
    few, many = [20.0, 21.0, 25.0], [20.0, 20.1, 20.2, 20.3, 20.4, 27.0]
    assert verdict(few, many, 0.5).difference == pytest.approx(np.mean(many) - np.mean(few))


def test_an_infinite_value_is_refused():
    with pytest.raises(ValueError, match="psnr of 1 runs is infinite"):
        verdict([20.0, 21.0], [np.inf, 22.0], 0.5)


@pytest.mark.parametrize(("asked", "message"), [(None, "iou: give --within"), (0, "positive"), (np.nan, "positive")])
def test_a_smallest_difference_is_asked_for(asked, message):
    assert (within_of("psnr"), within_of("psnr", 0.3)) == (0.5, 0.3)
    with pytest.raises(ValueError, match=message):
        within_of("iou", asked)
    with pytest.raises(ValueError, match="step_ms is not measured for each view; such metrics are psnr"):
        within_of("step_ms", asked)


def test_only_views_that_every_run_has_are_compared(tmp_path):
    write_run(tmp_path, "classical", 0, [20.0, 21.0, 22.0])
    write_run(tmp_path, "classical", 1, [10.0, 11.0])
    write_run(tmp_path, "qcolor", 5, [11.0, 14.0, 17.0])
    write_run(tmp_path, "qcolor", 6, [22.0, 21.0, float("nan")])
    frame = runs(tmp_path)
    one, two = (evaluations(frame[frame["field"] == field]) for field in ("classical", "qcolor"))
    found, moved = compare(one, two, 0.5)
    assert (found.difference, found.seeds) == (1.5, (2, 2))
    assert moved == pytest.approx(0, abs=1e-9)  # 1.5 in both views
    _, moved = compare(one, two.add([1.0, 2.0, 0.0]), 0.5)
    assert moved == pytest.approx(stats.t.ppf(0.975, 1) * 0.5)
    nothing, _ = compare(one[["2.png"]], two[["2.png"]], 0.5)
    assert (nothing.kind, nothing.seeds) == ("undecided", (0, 0))


def test_a_run_without_readable_views_has_no_row(tmp_path):
    kept, damaged, absent = (write_run(tmp_path, "classical", seed) for seed in range(3))
    (damaged / "eval.parquet").write_bytes(b"PAR1")
    (absent / "eval.parquet").unlink()
    assert set(evaluations(runs(tmp_path)).index) == {str(kept)}
    assert evaluations(pd.DataFrame({"path": [], "seed": []})).empty


@given(GROUP, st.integers(3, 6))
def test_means_over_scenes(group, scenes):
    """Of equal scenes the mean has the error of one / sqrt(n); scenes like them vary as the differences do."""
    one = judge(*yuen(group, np.add(group, 1.0)), 0.5)
    found, _ = over_scenes([one] * scenes)
    assert (found.difference, found.error) == pytest.approx((one.difference, one.error / scenes**0.5), rel=1e-6)
    assert found.freedom == pytest.approx(scenes * one.freedom, rel=1e-6)
    differences = np.arange(scenes) / 10
    _, like = over_scenes([judge(d, one.error, 5, 0.5) for d in differences])
    expected = stats.t.interval(0.95, scenes - 1, differences.mean(), stats.sem(differences))
    assert (like.difference - like.reach, like.difference + like.reach) == pytest.approx(expected)
