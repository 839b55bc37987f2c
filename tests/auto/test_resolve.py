"""`auto` in a configuration: what is decided, what stays as it is set."""

import math

import pytest

from qnerf.auto import asked, resolve
from qnerf.auto.rules import RULES
from qnerf.config.identity import identity
from qnerf.config.settings import settings_from
from tests.helpers.configs import composed
from tests.helpers.worlds import ball, constant, floor

BALL, FLOOR = ball(), floor()


def autos(node, path="") -> list[str]:
    if not isinstance(node, dict):
        return [path] if node == "auto" else []
    return [name for key, value in node.items() for name in autos(value, f"{path}.{key}".lstrip("."))]


@pytest.mark.parametrize("world", [BALL, FLOOR, constant(0), constant(0, channels=4)])
def test_everything_is_decided_and_builds(world):
    config = composed("needs=auto")
    resolved = resolve(config, world)
    left = {name for name in autos(resolved) if not name.endswith("qiren.method")}
    assert left == {"device", "needs.name"}
    settings_from(resolved)
    assert set(resolved["needs"]) == {"name", *asked(config)}
    for option in asked(config):
        numbers = [value for key, value in resolved["needs"][option].items() if key != "value"]
        assert all(math.isfinite(number) for number in numbers)


def test_the_given_configuration_is_left_as_it_is():
    config = composed("needs=auto")
    before = composed("needs=auto")
    resolve(config, FLOOR)
    assert config == before


def test_without_auto_nothing_is_asked_or_measured():
    for needs in ("none", "full"):
        config = composed(f"needs={needs}")
        assert asked(config) == []
        assert resolve(config, None) == config


def test_what_is_set_by_hand_wins():
    config = composed(
        "needs=auto", "appearance=4", "hash=C3", "cameras=se3", "shading=top", "contraction.name=l2", "render.near=0.3",
        "render.background=black", "visibility.cameras=2", "visibility.alpha=false", "occupancy.every=0",
    )  # fmt: skip
    resolved = resolve(config, BALL)
    assert resolved["appearance"] == 4
    assert resolved["hash"] == composed("hash=C3")["hash"]
    assert resolved["encoder"] == composed("hash=C3")["encoder"]
    assert resolved["cameras"]["name"] == "se3"
    assert resolved["shading"] == composed("shading=top")["shading"]
    assert (resolved["render"]["near"], resolved["render"]["background"]) == (0.3, "black")
    assert resolved["visibility"] == {"cameras": 2, "alpha": False, "resolution": 96}
    assert resolved["contraction"] == {"name": "l2"}
    assert asked(config) == ["render.far"]
    assert set(resolved["needs"]) == {"name", "render.far"}


@pytest.mark.parametrize("option", ["appearance", "render.background", "hash.levels", "visibility.cameras"])
def test_auto_on_one_option_alone_decides_that_one(option):
    config = composed(f"{option}=auto")
    assert asked(config) == [option]
    resolved = resolve(config, BALL)
    value = resolved["needs"][option]["value"]
    assert composed(f"{option}={str(value).lower()}") == resolved | {"needs": {"name": "none"}}


def test_the_encoder_follows_the_tables():
    resolved = resolve(composed("hash=auto"), FLOOR)
    for key in ("levels", "max_resolution", "log2_table_size"):
        assert resolved["encoder"][key] == resolved["hash"][key] == resolved["needs"][f"hash.{key}"]["value"]
    other = resolve(composed("hash=auto", "encoder.levels=3"), FLOOR)
    assert other["encoder"]["levels"] == 3 != other["hash"]["levels"]


def test_a_component_gets_the_options_that_it_has():
    config = composed("needs=auto", "hash=C7")
    box, unbounded = (resolve(config, world) for world in (BALL, FLOOR))
    assert box["contraction"] == {"name": "box", "half_extent": box["needs"]["contraction.name"]["half_extent"]}
    assert unbounded["contraction"] == {"name": "linf"}
    assert unbounded["cameras"] == {"name": "fixed"}
    assert resolve(composed("shading=auto", "shading.parts=3"), BALL)["shading"] == {"name": "merge", "parts": 3}


@pytest.mark.parametrize(("half", "expected"), [("0.7", 0.7), ("auto", None)])
def test_a_box_by_hand_stays_where_its_contraction_is_found_to_be_a_box(half, expected):
    config = composed("contraction.name=auto", f"+contraction.half_extent={half}")
    box, unbounded = (resolve(config, world) for world in (BALL, FLOOR))
    measured = box["needs"]["contraction.name"]["half_extent"]
    assert box["contraction"] == {"name": "box", "half_extent": expected or measured}
    assert unbounded["contraction"] == {"name": "linf"}


def test_what_was_decided_is_not_measured_again(monkeypatch):
    config = composed("needs=auto")
    first = resolve(config, BALL)
    for option in RULES:
        monkeypatch.setitem(RULES, option, None)
    assert resolve(config | {"needs": first["needs"]}, None) == first


def test_decisions_do_not_enter_the_identity():
    config = composed("needs=auto")
    decided = config | {"needs": resolve(config, BALL)["needs"]}
    assert identity(decided, "x") == identity(config, "x")
    assert identity(composed("needs=auto", "appearance=4"), "x") != identity(config, "x")


@pytest.mark.parametrize("stored", [3, None, {}, "value"])
def test_a_damaged_decision_is_one_line(stored):
    config = composed("appearance=auto")
    with pytest.raises(ValueError, match=r"needs\.appearance: expected a group with the key value, got"):
        resolve(config | {"needs": {"name": "none", "appearance": stored}}, BALL)
