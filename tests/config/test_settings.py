import json
import re

import pytest

from qnerf.config.settings import check_settings, settings_from
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
        ("qiren.layers=9223372036854775808", "qiren.layers must be within 64 bits, got 9223372036854775808"),
        ("store=", "store must not be empty"),
        ("stop.share=1e-310", "stop.share must be between 1e-09 and 0.5, got 1e-310"),
        ("train.eps=1e-310", "train.eps must be between 1e-30 and 1000000.0, got 1e-310"),
        ("train.rates.color=nan", "train.rates.color must be finite, got nan"),
        ("train.rates.color=[1]", "train.rates.color expects float, got [1] (list)"),
        ("density.initial=abc", "density.initial expects float, got 'abc' (str)"),
        ("color.rates={mlp:abc}", "color.rates.mlp expects float, got 'abc' (str)"),
        ("color.degree=5", "color.degree must be between 1 and 4, got 5"),
        ("encoder.name=[hash]", "encoder.name expects str, got ['hash'] (list)"),
        ("numerics=null", "numerics must be a group of options, got None"),
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


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"x": float("nan")}, "needs.x must be finite, got nan"),
        ({"x": [2**63]}, "needs.x[0] must be within 64 bits"),
        ({"x": "a\0b"}, "needs.x must be Unicode text without null characters"),
        ({"x": "\ud800"}, "needs.x must be Unicode text without null characters"),
        ({1: 2}, "needs: a key must be text, got 1"),
        (json.loads(50 * "[" + 50 * "]"), "is nested too deeply"),
    ],
)
def test_what_no_option_may_hold(value, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        settings_from(composed() | {"needs": value})


def test_options_that_are_not_decided_yet_are_left_out():
    config = composed("appearance=auto", "render.far=auto")
    check_settings(config, ["appearance", "render.far"])
    with pytest.raises(ValueError, match="appearance expects int"):
        check_settings(config, ["render.far"])
