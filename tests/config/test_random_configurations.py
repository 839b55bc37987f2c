"""Configurations made from the declarations of all options: each builds a model, or is refused in one line.

`QNERF_HYPOTHESIS=long python -m pytest tests/config/test_random_configurations.py` tries 20,000 of them.
"""

import copy
import os
import re
from collections.abc import Iterator
from dataclasses import is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, get_type_hints

import pytest
from hypothesis import HealthCheck, given, reject, settings
from hypothesis import strategies as st

from qnerf import experiment
from qnerf.building import components
from qnerf.building import scene as building_scene
from qnerf.building.components import REGISTRIES, SHARED
from qnerf.building.model import build_model, parameter_counts, ray_table
from qnerf.building.scene import prepare
from qnerf.config import memory
from qnerf.config.identity import run_id
from qnerf.config.registry import options_of
from qnerf.config.settings import declared, only_acting, schema
from qnerf.heads import HEADS
from qnerf.model.labels import labels, slug
from qnerf.scenes import SCENES
from tests.helpers.configs import CONF, TINY, composed
from tests.helpers.scenes import write_scene

LONG = os.environ.get("QNERF_HYPOTHESIS") == "long"
MEMORY = 2**28  # bytes that the machine seems to have: larger models are refused, so that every example is quick
MAX_CELLS = 32  # per axis of the grids of empty space; finer ones take seconds

TINY_SCENE = "../scene"  # from the working folder

HOSTILE: list[Any] = [
    None, True, False, 0, -1, 1, 7, 0.5, -0.5, 1.0, 1e-310, 1e-30, 1e30, 1e308, -1e308,
    float("nan"), float("inf"), -float("inf"), 2**31, 2**62, 2**63, -(2**63) - 1, 10**40,
    "", "auto", "abc", "1", "nan", "a\nb", "a\0b", "\x1b[31m", "\u202e", "\ud800", "x" * 5000,
    [], {}, [None], ["abc"], [1], [0, -1], [8, 8.5], [float("nan")], [[1]], [[[]]], {"a": 1}, {"name": ["a"]}, {1: 2},
    {"value": float("nan")},
]  # fmt: skip
for _ in range(100):
    HOSTILE[-1] = [HOSTILE[-1]]  # deeper than any parser likes

Keys = tuple[str, ...]
HEAD_GROUPS = ("density", "color", "head")


@cache
def base(*overrides: str) -> dict[str, Any]:
    sampler = () if {"sampler", "photograph", "distance"} & set(re.split(r"\W", "".join(overrides))) else TINY
    config = composed("hash=C7", "device=cpu", "visibility.resolution=16", *overrides, *sampler)
    return only_acting(config)


def choices() -> list[tuple[str, ...]]:
    """Overrides to begin with: each choice of each group; in the short form a few."""
    few: list[tuple[str, ...]] = [
        ("field=qboth", "qiren.qubits=3"),
        ("needs=auto", "scene=nerfstudio", f"scene.path={TINY_SCENE}"),
        ("needs=full", "train=paper", "scene=blender", f"scene.path={TINY_SCENE}"),
        ("scene=photograph",),
        ("scene=distance",),
    ]
    groups = [path for path in sorted(CONF.iterdir()) if path.is_dir() and path.name not in ("hydra", "head", "scene")]
    every = [(f"{group.name}={file.stem}",) for group in groups for file in sorted(group.glob("*.yaml"))]
    return few + [one for one in every if not one[0].endswith(("=base", "train=fit"))] if LONG else few


def declarations(config: dict[str, Any]) -> list[tuple[Keys, Any]]:
    """Path and annotation of each option that the configuration holds."""
    return [*settings_declarations(config), *component_declarations(config)]


def settings_declarations(config: dict[str, Any]) -> Iterator[tuple[Keys, Any]]:
    for group, hint in get_type_hints(schema(config), include_extras=True).items():
        if is_dataclass(hint):
            for name, inner in get_type_hints(hint, include_extras=True).items():
                yield (group, name), inner
        else:
            yield (group,), hint
    for group in filter(config.__contains__, HEAD_GROUPS):
        for name, hint in declared(group).items():
            yield (group, name), hint


def component_declarations(config: dict[str, Any]) -> Iterator[tuple[Keys, Any]]:
    components = [item for item in REGISTRIES.items() if item[0] in config]
    chosen = [(group, registry, config[group]["name"]) for group, registry in components]
    shared = [(group, *of) for group, of in SHARED.items() if group in config]
    parts = [((group,), registry.get(name)) for group, registry, name in chosen + shared if name in registry.names()]
    heads = [(group, head) for group in HEAD_GROUPS if group in config for head in HEADS.names()]
    parts += [(path, HEADS.get(path[1])) for path in heads]
    for path, component in parts:
        for name, (_, hint) in options_of(component).items():
            yield (*path, name), hint


def holder(config: dict[str, Any], path: Keys) -> dict[str, Any]:
    """The group that holds the option; an empty one if it was replaced by another value."""
    node: Any = config
    for key in path[:-1]:
        node = node.get(key) if isinstance(node, dict) else None
    return node if isinstance(node, dict) else {}


@st.composite
def configurations(draw: st.DrawFn) -> dict[str, Any]:
    """A configuration, some of whose components and options were replaced."""
    config = copy.deepcopy(base(*draw(st.sampled_from(choices()))))
    for group, registry in REGISTRIES.items():
        if group != "scene" and group in config and draw(st.integers(0, 3)) == 0:
            name = draw(st.sampled_from(registry.names()))
            config[group] = {"name": name} | {
                option: copy.copy(parameter.default)
                for option, parameter in registry.options(name).items()
                if parameter.default is not parameter.empty
            }
    for group in filter(config.__contains__, HEAD_GROUPS):
        if draw(st.booleans()):
            config[group]["name"] = draw(st.sampled_from(HEADS.names()))
    options = declarations(config)
    for _ in range(draw(st.integers(0, 3))):
        path, hint = draw(st.sampled_from(options))
        mistake = draw(st.sampled_from(["none", "none", "value", "value", "group", "missing", "unknown"]))
        if mistake == "none" and "Any" not in str(hint):
            holder(config, path)[path[-1]] = draw(st.from_type(hint))
        elif mistake == "missing":
            holder(config, path).pop(path[-1], None)
        elif mistake == "unknown":
            holder(config, path)[draw(st.sampled_from(["other", "", "name", "a.b"]))] = 3
        elif mistake != "none":
            path = path[:-1] or path if mistake == "group" else path
            holder(config, path)[path[-1]] = copy.deepcopy(draw(st.sampled_from(HOSTILE)))
    return config


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A working folder, and a scene that stands for all of them: reading images has its own tests."""
    folder = tmp_path_factory.mktemp("random")
    write_scene(folder / "scene")
    (folder / "work").mkdir()

    def build(registry: Any, node: Any, *wiring: Any) -> Any:
        if registry is SCENES and node["name"] not in ("nerfstudio", "photograph", "distance"):
            SCENES.check(node["name"], {key: value for key, value in node.items() if key != "name"})
            node = {"name": "nerfstudio", "path": TINY_SCENE}
        return components.component(registry, node, *wiring)

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder / "work")
        patch.setattr(building_scene, "component", build)
        patch.setattr(memory, "available_bytes", lambda: MEMORY)
        yield folder


def built(config: dict[str, Any]) -> None:
    """All that a run does before it writes."""
    if "head" in config:
        task = experiment.SignalTask(config)
        run_id(slug(config), config, task.scene.fingerprint)
        labels(config)
        return
    resolved, options, scene = prepare(config, begun=True)
    grids = options.visibility.cameras or options.visibility.alpha or options.occupancy.every
    if grids and options.visibility.resolution > MAX_CELLS:
        reject()
    model = build_model(options, scene)
    ray_table(options, scene)
    run_id(slug(config), config, scene.fingerprint)
    labels(resolved)
    parameter_counts(model)


def mistake_in(config: dict[str, Any]) -> ValueError | None:
    """The error that refuses the configuration; None if it builds. Any other exception is a bug."""
    try:
        built(config)
    except ValueError as error:
        return error
    return None


@settings(
    max_examples=20_000 if LONG else 60,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much, HealthCheck.data_too_large],
)
@given(config=configurations())
def test_a_configuration_builds_a_model_or_is_refused_in_one_line(folder: Path, config: dict[str, Any]) -> None:
    error = mistake_in(config)
    assert error is None or "\n" not in str(error).strip(), "one line"
    assert not isinstance(error, UnicodeError), "a message of ours"
    assert not list((folder / "work").iterdir()), "nothing is written"


@pytest.mark.parametrize("overrides", choices())
def test_what_the_random_ones_begin_with_builds(folder: Path, overrides: tuple[str, ...]) -> None:
    assert mistake_in(copy.deepcopy(base(*overrides))) is None
