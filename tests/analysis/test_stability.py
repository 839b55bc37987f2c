import pytest
from qnerf.analysis import load
from qnerf.analysis.tables import stability
from qnerf.analysis.tables.__main__ import main

from tests.helpers.packed_stores import write_run


@pytest.fixture
def store(tmp_path):
    for seed, (classical, circuit) in enumerate([(25.0, 25.0), (25.4, 24.6), (25.2, 23.4), (14.0, 25.2)]):
        write_run(tmp_path, "classical", seed, [classical])
        write_run(tmp_path, "qcolor", seed, [circuit])
    return tmp_path


def test_slips_are_counted_below_the_rows_median_and_collapses_below_the_scenes_best(store):
    data = stability(load.runs(store), ["field"]).data
    assert data.loc["classical"].drop(["mean", "std"]).to_dict() == {
        "median": 25.1,
        "worst": 14.0,
        "best": 25.4,
        "n": 4,
        "slipped": 1,
        "collapsed": 1,
    }
    assert data.loc["qcolor", ["slipped", "collapsed"]].tolist() == [0, 0]


def test_a_row_that_collapsed_as_a_whole_has_not_slipped(tmp_path):
    for seed in (0, 1):
        write_run(tmp_path, "classical", seed, [14.0])
        write_run(tmp_path, "qcolor", seed, [25.0])
        write_run(tmp_path, "classical", seed, [14.0], scene="chair")
    data = stability(load.runs(tmp_path), ["scene_name", "field"]).data
    assert data.loc[("poster", "classical"), ["slipped", "collapsed"]].tolist() == [0, 2]
    assert data.loc[("chair", "classical"), "collapsed"] == 0


def test_stability_counts_decibels_alone(store):
    with pytest.raises(ValueError, match="--metric: without effect on this table"):
        main([str(store), "--rows", "field", "--stability", "--metric", "ssim"])
