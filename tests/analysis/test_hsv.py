import numpy as np
import pytest
from qnerf.analysis import hsv
from qnerf.analysis.images import panels, pictures
from qnerf.analysis.load import runs

from tests.helpers.packed_stores import picture, write_run

RANDOM = np.random.default_rng(0)


def noise(height=6, width=5):
    return RANDOM.integers(0, 256, (height, width, 3), dtype=np.uint8)


def of_kinds(frame):
    return {"classical": frame[frame["field"] == "classical"], "quantum": frame[frame["field"] == "qcolor"]}


@pytest.fixture
def store(tmp_path):
    """Two views; classical renders are the truth, quantum ones its half: hue and saturation stay, value halves."""
    truths = {f"v{view}": 2 * RANDOM.integers(20, 120, (8, 6, 3), dtype=np.uint8) for view in (0, 1)}
    for field, factor in (("classical", 1), ("qcolor", 2)):
        for seed in (0, 1):
            drawn = {name: picture(truth, truth // factor, noise(8, 6), noise(8, 6)) for name, truth in truths.items()}
            write_run(tmp_path, field, seed, pictures=drawn)
    return tmp_path, truths


@pytest.mark.parametrize("factor", [1, 4, 7])
def test_panels_are_the_pixels_that_were_drawn(tmp_path, factor):
    drawn = [noise() for _ in range(4)]
    run = write_run(tmp_path, pictures={"a": picture(*drawn, factor=factor)})
    assert list(pictures(run)) == ["a"]
    for panel, pixels in zip(panels(pictures(run)["a"]).values(), drawn, strict=True):
        np.testing.assert_array_equal(panel, pixels)


def test_hsv_names_what_is_no_such_picture(tmp_path):
    run = write_run(tmp_path, pictures={"narrow": noise(4, 7)})
    with pytest.raises(
        ValueError, match=r"narrow.png: expected truth \| render \| error \| depth of equal width, got 7"
    ):
        panels(pictures(run)["narrow"])


def test_pixels_are_those_of_truth_and_renders(store):
    folder, truths = store
    samples = hsv.samples(of_kinds(runs(folder)))
    assert samples.groupby(["source", "seed"], observed=True, dropna=False).size().tolist() == [96] * 5
    truth = samples[samples["source"] == "truth"]
    brightest = np.concatenate([truths[name].reshape(-1, 3).max(axis=1) for name in ("v0", "v1")])
    assert truth["value"].to_numpy() == pytest.approx(brightest / 255)
    assert truth["seed"].isna().all()


def test_a_darker_copy_differs_in_value_alone(store):
    folder, _ = store
    tests = hsv.tests(hsv.samples(of_kinds(runs(folder)))).set_index(["channel", "pair", "seed"])
    assert len(tests) == 3 * 3 * 2
    for channel in hsv.CHANNELS:
        same = tests.loc[(channel, "truth - classical", 0)]
        assert same["ks"] == 0
    assert tests.loc[("value", "truth - quantum", 1), "ks"] > 0.5
    assert tests.loc[("hue", "truth - quantum", 1), "ks"] < 1e-12


def test_grey_pixels_have_no_hue():
    image = np.array([[[128, 128, 128], [0, 0, 0], [255, 0, 0], [128, 125, 125], [0, 0, 255]]], dtype=np.uint8)
    pixels = hsv.pixels(image)
    assert pixels["hue"].isna().tolist() == [True, True, False, True, False]
    assert pixels["hue"].dropna().tolist() == pytest.approx([0, 2 / 3])
    assert pixels["saturation"].tolist() == pytest.approx([0, 0, 1, 3 / 128, 1])


def test_hsv_refuses_what_cannot_be_compared(store):
    folder, _ = store
    write_run(folder, "qcolor", 2, scene="chair")
    with pytest.raises(ValueError, match=r"2 scenes in one table \(chair, poster\)"):
        hsv.samples(of_kinds(runs(folder)))
    bare = write_run(folder, "qcolor", 3)
    frame = runs(folder)
    with pytest.raises(ValueError, match="no picture that all 5 runs have; 1 of them have none at all"):
        hsv.samples(of_kinds(frame[(frame["scene_name"] == "poster") | (frame["path"] == str(bare))]))
