import pytest
from qnerf.analysis.load import runs
from qnerf.analysis.tables import smallest

from tests.helpers.packed_stores import write_run


@pytest.fixture
def store(tmp_path):
    """`poster`: a circuit 0.3 dB below the MLP, with fewer parameters; `chair`: 3 dB below."""
    for scene, loss in (("poster", 0.3), ("chair", 3.0)):
        for seed in (0, 1):
            write_run(tmp_path, "classical", seed, [25.0, 27.0], scene=scene)
            write_run(tmp_path, "qcolor", seed, [25.0 - loss, 27.0 - loss], scene=scene, results={"step_ms": 99.0})
    return tmp_path


def test_each_scene_gets_its_smallest_configuration_within_the_tolerance(store):
    data = smallest(runs(store), ["field"]).data.set_index("scene")
    assert data["best"].to_dict() == {"poster": "classical", "chair": "classical"}
    assert data["smallest"].to_dict() == {"poster": "qcolor", "chair": "classical"}
    assert data.loc["poster", "smallest_size"] == 393216 + 1222 + 491
    assert data.loc["poster", ["difference", "reach"]].tolist() == pytest.approx([-0.3, 0])
    assert data.loc["poster", "verdict"] == "equivalent, below 0"


def test_size_and_difference_are_the_callers(store):
    frame = runs(store)
    assert set(smallest(frame, ["scene_name", "field"], size="step_ms").data["smallest"]) == {"classical"}
    assert set(smallest(frame, ["field"], within=5).data["smallest"]) == {"qcolor"}
    assert set(smallest(frame, ["field"], within=0.1).data["smallest"]) == {"classical"}


def test_a_mean_within_the_tolerance_may_not_be_shown_to_be(tmp_path):
    for seed, loss in ((0, -1.0), (1, 1.4)):
        write_run(tmp_path, "classical", seed, [25.0, 25.0])
        write_run(tmp_path, "qcolor", seed, [25.0 - loss, 25.0 - loss])
    table = smallest(runs(tmp_path), ["field"])
    assert table.text.loc[0, ["difference", "verdict"]].tolist() == ["-0.20 ± 15.25", "undecided"]  # 12.7 x 1.2


def test_a_lower_metric_may_be_the_better_one(tmp_path):
    for field, error in (("classical", 0.1), ("qcolor", 0.3)):
        write_run(tmp_path, field, results={"depth_error": error})
    assert smallest(runs(tmp_path), ["field"], metric="depth_error", within=0.1).data.loc[0, "best"] == "classical"


def test_mistakes_are_named(store):
    frame = runs(store)
    with pytest.raises(ValueError, match=r"expected a key that tells configurations apart, got only scene_name"):
        smallest(frame, ["scene_name"])
    with pytest.raises(ValueError, match="no finished run of 8 has lpips"):
        smallest(frame, ["field"], size="lpips")
