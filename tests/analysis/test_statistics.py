import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from analysis.load import runs
from analysis.statistics import bootstrap, evaluations, paired
from tests.helpers.packed_stores import write_run

DIFFERENCES = arrays(float, st.tuples(st.integers(1, 5), st.integers(1, 8)), elements=st.floats(-30, 30, width=32))


@given(DIFFERENCES)
def test_the_interval_holds_the_mean_difference(differences):
    found = bootstrap(differences, resamples=500)
    assert found.mean == pytest.approx(differences.mean())
    assert found.low - 1e-9 <= found.mean <= found.high + 1e-9
    assert differences.min() - 1e-9 <= found.low
    assert found.high <= differences.max() + 1e-9
    assert (found.seeds, found.views) == differences.shape


@given(DIFFERENCES, st.floats(-50, 50))
def test_a_shift_shifts_the_interval(differences, shift):
    one, other = bootstrap(differences, resamples=200), bootstrap(differences + shift, resamples=200)
    assert [other.low, other.high] == pytest.approx([one.low + shift, one.high + shift], abs=1e-6)


def test_one_seed_is_the_ordinary_bootstrap_over_views():
    views = np.random.default_rng(0).normal(size=400)
    found = bootstrap(views[None])
    error = views.std() / np.sqrt(len(views))
    assert [found.low, found.high] == pytest.approx(
        [views.mean() - 1.96 * error, views.mean() + 1.96 * error], abs=0.01
    )


def test_95_percent_of_intervals_hold_the_truth_however_hard_the_views_are():
    random = np.random.default_rng(3)
    hits = 0
    for _ in range(200):
        differences = 0.1 * random.normal(size=(10, 1)) + 0.8 * random.normal(size=(1, 22))
        found = bootstrap(differences + 0.5 * random.normal(size=(10, 22)), resamples=500)
        hits += found.low <= 0 <= found.high
    assert 180 <= hits <= 198  # the nominal 190; views drawn anew inside each seed give 125


def test_no_pairs_give_no_interval():
    assert bootstrap(np.empty((0, 4))) is None
    assert bootstrap(np.empty((3, 0))) is None


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
