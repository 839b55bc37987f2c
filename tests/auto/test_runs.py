"""Runs that decide what their scene needs: what they store, how they go on, what they make of bad input."""

import pandas as pd
import pytest

from qnerf.experiment import run
from qnerf.probes import trained
from qnerf.records import read_config
from tests.helpers.worlds import ball, cameras, constant, ring, scene, write

BALL = ball(views=12, size=32, focal=22.0, radius=0.25)
AUTO = ("needs=auto", "field=classical", "visibility.alpha=auto", "visibility.resolution=12", "hash.log2_table_size=8")


@pytest.fixture
def auto(tiny, tmp_path):
    """A small configuration with needs=auto for a scene that is written to a folder of its own."""

    def make(world, *overrides: str) -> dict:
        folder = tmp_path / "world"
        path = folder if folder.exists() else write(world, folder)
        return tiny("scene=nerfstudio", f"scene.path={path}", *AUTO, "hash=auto", *overrides)

    return make


def test_decisions_are_the_configuration_and_columns(auto):
    outcome = run(auto(BALL))
    config = read_config(outcome.path)
    assert config["contraction"]["name"] == "box"
    row = pd.read_parquet(outcome.path / "summary.parquet").iloc[0]
    assert row["needs.contraction.name"] == "box"
    assert row["needs.render.background"] == config["render"]["background"] == "white"
    assert row["needs.contraction.name.half_extent"] == config["contraction"]["half_extent"] > 0
    assert "needs.appearance.exposure_spread" not in row.index  # nothing on the ball tells

    loaded = trained.load(outcome.path)
    assert loaded.settings.contraction == config["contraction"]
    assert loaded.model.field.mask is not None
    assert "finished already" in run(auto(BALL)).message


OUTWARD = scene(constant(9).images, cameras(ring(6, outward=True)))


def test_auto_that_nothing_decides_is_one_line_and_writes_nothing(auto, tmp_path):
    for override, message in {
        "train.lr=auto": "train.lr expects float, got 'auto'",
        "hash.min_resolution=auto": r"encoder\.min_resolution expects int, got 'auto'",
        "visibility.cameras=4": r"visibility\.cameras: no cell is seen by 2 of 5 training cameras",
    }.items():
        with pytest.raises(ValueError, match=message) as caught:
            run(auto(OUTWARD, override))
        assert "\n" not in str(caught.value)
        assert not (tmp_path / "runs").exists()
