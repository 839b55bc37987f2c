import copy
import hashlib
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qnerf.config.identity import EXECUTION, clean, flatten, identity, picture_names, plain, run_id

CONFIG = {
    "seed": 0,
    "device": "auto",
    "threads": None,
    "store": "runs",
    "run": {"force": False},
    "hydra": {"verbose": False},
    "scene": {"name": "nerfstudio", "path": "/data/fox", "downscale": 1},
    "train": {"lr": 1e-2, "steps": 3000, "warm": [1, 2]},
}

scalars = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=8)
names = st.text("abcdefg_", min_size=1, max_size=5)
configs = st.dictionaries(
    names,
    st.recursive(scalars, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(names, inner, max_size=3)),
    max_size=5,
)


def changed(**values: object) -> dict:
    return copy.deepcopy(CONFIG) | values


def test_identity_is_stable_between_versions() -> None:
    text = (
        '{"scene":{"downscale":1,"name":"nerfstudio","path":"abc"},"seed":0,'
        '"train":{"lr":0.01,"steps":3000,"warm":[1,2]}}'
    )
    assert identity(CONFIG, "abc") == hashlib.sha256(text.encode()).hexdigest()[:10]


@pytest.mark.parametrize("key", EXECUTION)
def test_how_a_run_is_executed_does_not_change_it(key: str) -> None:
    assert identity(changed(**{key: {"other": 1}})) == identity(CONFIG)
    assert identity({k: v for k, v in CONFIG.items() if k != key}) == identity(CONFIG)


def test_scene_enters_by_its_contents() -> None:
    moved = changed(scene=CONFIG["scene"] | {"path": "/elsewhere"})
    assert identity(moved) != identity(CONFIG)
    assert identity(moved, "abc") == identity(CONFIG, "abc") != identity(CONFIG, "abd")
    assert identity(changed(scene=CONFIG["scene"] | {"downscale": 2}), "abc") != identity(CONFIG, "abc")


@pytest.mark.parametrize("lr", [0.01, "1", 1, True, None, float("inf")])
def test_every_value_counts(lr: object) -> None:
    others = [identity({"lr": other}) for other in (0.02, "0.01", 2, False, "None", float("-inf"))]
    assert identity({"lr": lr}) not in others


@given(st.integers(-(2**53), 2**53))
def test_equal_numbers_are_equal_however_written(value: int) -> None:
    assert identity({"a": value}) == identity({"a": float(value)}) == identity({"a": np.int64(value)})


@given(configs)
def test_order_of_keys_does_not_count(config: dict) -> None:
    backwards = dict(reversed(list(config.items())))
    assert identity(backwards) == identity(config)
    assert re.fullmatch("[0-9a-f]{10}", identity(config))


@given(st.text(max_size=200))
def test_run_id_is_a_plain_folder_name(slug: str) -> None:
    name = run_id(slug, CONFIG)
    assert re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*-[0-9a-f]{10}", name)
    assert len(name) <= 91
    assert clean(clean(slug)) == clean(slug)


@pytest.mark.parametrize(
    ("slug", "expected"),
    [("fox qcolor 1L+2S", "fox-qcolor-1L-2S"), ("../../etc", "etc"), ("", "run"), (".tmp", "tmp"), ("ü/ß", "run")],
)
def test_clean(slug: str, expected: str) -> None:
    assert clean(slug) == expected


@pytest.mark.parametrize(
    ("images", "expected"),
    [
        (["images/1.png", "images/2.jpg"], ["images-1", "images-2"]),
        (["猫.png", "狗.png", "c.png"], ["run.0", "run.1", "c"]),
        (["a.1.png", "a.png", "a.jpg"], ["a.1", "a.1.1", "a.2"]),
        (["x" * 90 + "a", "x" * 90 + "b"], ["x" * 80 + ".0", "x" * 80 + ".1"]),
    ],
)
def test_pictures_have_names_of_their_own(images: list[str], expected: list[str]) -> None:
    assert picture_names(images) == expected


def test_flatten() -> None:
    flat = flatten({"a": {"b": {"c": 1}, "d": [1, "x"]}, "e": None, "f": {}, "g": Path("x/y")})
    assert flat == {"a.b.c": 1, "a.d": '[1, "x"]', "e": None, "f": "{}", "g": "x/y"}


@given(configs)
def test_flatten_leaves_only_cells(config: dict) -> None:
    assert all(value is None or isinstance(value, (bool, int, float, str)) for value in flatten(config).values())


def test_what_is_not_plain_is_named() -> None:
    with pytest.raises(ValueError, match=r"config\.a\.b\[1\]: expected text, number.*got object"):
        plain({"a": {"b": [1, object()]}})
