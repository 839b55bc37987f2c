import re

import pytest

from qnerf.config.settings import settings_from
from tests.helpers.configs import composed


def test_every_value_arrives():
    settings = settings_from(composed("seed=3", "train.steps=7", "render.near=0.1"))
    assert (settings.seed, settings.train.steps, settings.render.near) == (3, 7, 0.1)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("train.steps=-1", "train.steps must be between 1 and 1000000000, got -1"),
        ("train.steps=1.5", "train.steps expects int, got 1.5 (float)"),
        ("train.lr=0", "train.lr must be between 1e-30 and 1000000.0, got 0"),
        ("train.lr=nan", "train.lr must be finite, got nan"),
        ("train.rays=many", "train.rays expects int, got 'many' (str)"),
        ("render.background=blue", "render.background expects one of last_sample, white, black, random, got 'blue'"),
        ("render.near=2000", "render.near must be below render.far, got 2000 and 1000.0"),
        ("device=gpu", "device expects one of auto, cpu, cuda, got 'gpu'"),
        ("numerics.dtype=float16", "numerics.dtype expects one of float32, float64, got 'float16'"),
        ("seed=-1", "seed must be between 0 and"),
        ("threads=0", "threads must be between 1 and 1024, got 0"),
        ("geo_features=-1", "geo_features must be between 0 and 65536, got -1"),
        ("visibility.resolution=1", "visibility.resolution must be between 2 and 512, got 1"),
    ],
)
def test_a_bad_value_is_one_line(override, message):
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        settings_from(composed(override))
    assert "\n" not in str(caught.value)


def test_missing_and_unknown_keys_are_named():
    config = composed()
    del config["train"]["rays"]
    with pytest.raises(ValueError, match="train: missing rays"):
        settings_from(config)
    config = composed() | {"extra": 1}
    with pytest.raises(ValueError, match="unknown option extra=1"):
        settings_from(config)
