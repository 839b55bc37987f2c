import re

import pytest

from qnerf.building.configuration import Configuration
from tests.helpers.configs import worked_out


def test_settings_have_every_value():
    settings = Configuration.of(worked_out("seed=3", "train.steps=7", "render.near=0.1").acting).settings
    assert (settings.seed, settings.train.steps, settings.render.near) == (3, 7, 0.1)
    assert (settings.color["degree"], settings.stop.rays, settings.store) == (4, 2048, "runs")  # what does not act


BAD = {
    "train.steps=-1": "train.steps must be between 1 and 1000000000, got -1",
    "train.steps=1.5": "train.steps expects int, got 1.5 (float)",
    "train.lr=0": "train.lr must be between 1e-30 and 1000000.0, got 0",
    "train.rays=many": "train.rays expects int, got 'many' (str)",
    "render.background=blue": "render.background expects one of last_sample, white, black, random, got 'blue'",
    "render.near=2000 render.far=1000": "render.near must be below render.far, got 2000 and 1000",
    "device=gpu": "device=gpu: PyTorch has no such device here; known: auto, ",
    "numerics.dtype=float16": "numerics.dtype expects one of float32, float64, got 'float16'",
    "qiren.layers=9223372036854775808": "color.qiren.layers must be between 1 and 64, got 9223372036854775808",
    "store=": "store must not be empty",
    "train.eps=1e-310": "train.eps must be between 1e-30 and 1000000.0, got 1e-310",
    "train.rates.color=[1]": "train.rates.color expects float, got [1] (list)",
    "sampler.samples=[]": "sampler.samples must not be empty",
    "density.initial=abc": "density.initial expects float, got 'abc' (str)",
}


def test_a_bad_value_is_one_line():
    for override, message in BAD.items():
        with pytest.raises(ValueError, match=re.escape(message)) as caught:
            assert worked_out(*override.split()).settings
        assert "\n" not in str(caught.value)
