"""Hashes, slugs and names of pictures."""

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qnerf.config.identity import clean, digest, flatten, picture_names, plain

values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=10,
)
configs = st.dictionaries(st.text(max_size=5), values, max_size=5)


@given(configs)
def test_digest_does_not_depend_on_the_order_of_keys(config):
    assert digest(dict(reversed(list(config.items()))), "a") == digest(config, "a")
    assert re.fullmatch("[0-9a-f]{10}", digest(config, "a"))
    assert digest(config, "a") != digest(config, "b")


def test_digest_tells_values_apart():
    """Numbers of one value are the same, and so are floats that differ in their last bits only."""
    assert len({digest({"a": value}, "") for value in (1, 1.0, np.int64(1), np.float32(1))}) == 1
    assert digest({"a": 0.1 + 0.2}, "") == digest({"a": 0.3}, "")
    assert len({digest({"a": value}, "") for value in (1, True, "1", None, [1], 1.0001, 1 + 1e-7)}) == 7


@given(st.text(max_size=200))
def test_clean_gives_a_plain_folder_name(slug):
    assert re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,79}", clean(slug))
    assert clean(clean(slug)) == clean(slug)


def test_clean_replaces_other_characters():
    pairs = {"fox qcolor 1L+2S": "fox-qcolor-1L-2S", "../../etc": "etc", "": "run", ".tmp": "tmp", "ü/ß": "run"}
    assert {slug: clean(slug) for slug in pairs} == pairs


def test_pictures_have_names_of_their_own():
    for images, expected in (
        (["images/1.png", "images/2.jpg"], ["images-1", "images-2"]),
        (["猫.png", "狗.png", "c.png"], ["run.0", "run.1", "c"]),
        (["a.1.png", "a.png", "a.jpg"], ["a.1", "a.1.1", "a.2"]),
        (["x" * 90 + "a", "x" * 90 + "b"], ["x" * 80 + ".0", "x" * 80 + ".1"]),
    ):
        assert picture_names(images) == expected


def test_flatten_joins_names_of_groups_by_dots():
    flat = flatten({"a": {"b": {"c": 1}, "d": [1, "x"]}, "e": None, "f": {}, "g": Path("x/y")})
    assert flat == {"a.b.c": 1, "a.d": '[1, "x"]', "e": None, "f": "{}", "g": "x/y"}


def test_plain_names_what_is_not():
    with pytest.raises(ValueError, match=r"config\.a\.b\[1\]: expected text, number.*got object"):
        plain({"a": {"b": [1, object()]}})
