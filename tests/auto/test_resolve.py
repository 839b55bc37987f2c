"""`auto` in a configuration: what is decided, what stays as it is set."""

import math

import pytest

from qnerf.auto import asked, columns, resolve
from qnerf.building.configuration import Configuration
from tests.helpers.configs import composed, worked_out
from tests.helpers.worlds import ball, constant, floor

BALL, FLOOR = ball(), floor()


def autos(node, path="") -> set[str]:
    if not isinstance(node, dict):
        return {path} if node == "auto" else set()
    return {name for key, value in node.items() for name in autos(value, f"{path}.{key}".lstrip("."))}


def test_auto_is_decided_everywhere_and_builds():
    for world in (BALL, FLOOR, constant(0), constant(0, channels=4)):
        config = worked_out("needs=auto").complete
        before = worked_out("needs=auto").complete
        resolved, decisions = resolve(config, world)
        assert config == before
        assert autos(resolved) == {"device", "color.qiren.method"}
        assert Configuration.of(resolved).settings
        assert set(decisions) == set(asked(config))
        assert all(math.isfinite(value) for value in columns(decisions).values() if isinstance(value, float))


def test_auto_is_not_asked_where_it_is_not_set():
    for needs in ("none", "full"):
        config = worked_out(f"needs={needs}").complete
        assert asked(config) == []
        assert resolve(config, None) == (config, {})


def test_auto_leaves_what_is_set_by_hand():
    config = worked_out(
        "needs=auto", "appearance=4", "hash=C3", "cameras=se3", "shading=none", "contraction.name=l2",
        "render.near=0.3", "render.background=black", "visibility.cameras=2", "visibility.alpha=false",
        "train.error_rays=0.5",
    ).complete  # fmt: skip
    resolved, decisions = resolve(config, BALL)
    assert set(decisions) == {"render.far"}
    resolved["render"]["far"] = "auto"
    assert resolved == config


def test_auto_on_one_option_decides_that_one():
    for option in ("appearance", "render.background", "encoder.levels", "visibility.cameras"):
        config = composed(f"{option}=auto")
        assert asked(config) == [option]
        resolved, decisions = resolve(config, BALL)
        assert composed(f"{option}={str(decisions[option].value).lower()}") == resolved


def test_tables_may_be_decided_but_for_one_option():
    resolved, decisions = resolve(worked_out("hash=auto", "encoder.levels=3").complete, FLOOR)
    assert resolved["encoder"]["levels"] == 3
    assert set(decisions) == {"encoder.max_resolution", "encoder.log2_table_size"}


def test_a_component_gets_the_options_that_it_has():
    config = worked_out("needs=auto", "hash=C7").complete
    (box, because), (unbounded, _) = (resolve(config, world) for world in (BALL, FLOOR))
    half = because["contraction.name"].because["half_extent"]
    assert box["contraction"] == {"name": "box", "half_extent": half}
    assert columns(because)["needs.contraction.name.half_extent"] == half
    assert unbounded["contraction"] == {"name": "linf"}
    assert unbounded["cameras"] == {"name": "fixed"}
    shaded, _ = resolve(composed("shading=auto", "shading.parts=3"), BALL)
    assert shaded["shading"] == {"name": "merge", "parts": 3}


@pytest.mark.parametrize(("half", "expected"), [("0.7", 0.7), ("auto", None)])
def test_a_box_by_hand_stays_where_its_contraction_is_found_to_be_a_box(half, expected):
    config = composed("contraction.name=auto", f"+contraction.half_extent={half}")
    (box, because), (unbounded, _) = (resolve(config, world) for world in (BALL, FLOOR))
    measured = because["contraction.name"].because["half_extent"]
    assert box["contraction"] == {"name": "box", "half_extent": expected or measured}
    assert unbounded["contraction"] == {"name": "linf"}
