"""A run is what acts: which options its configuration holds, and which of them its id hashes."""

import copy
import functools
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qnerf.building.acting import COMPONENTS
from qnerf.building.components import component
from qnerf.building.configuration import Configuration
from qnerf.config.identity import flatten
from qnerf.geometry.contraction import CONTRACTIONS
from qnerf.geometry.pose_refinement import CAMERAS
from qnerf.heads import HEADS
from qnerf.records.schemas import RECORDED
from tests.helpers.configs import composed, worked_out
from tests.helpers.trainer import trainer


def test_id_tells_apart_what_acts():
    for one, other, same in (
        ("field=classical qiren.layers=1", "field=classical qiren.layers=2", True),
        ("field=qcolor qiren.layers=1", "field=qcolor qiren.layers=2", False),
        ("density=amplitude color=mlp density.qiren.layers=1", "density=amplitude color=mlp", True),
        ("field=classical", "field=classical density=qfgn", False),
        ("density=qfgn qiren.gain=1", "density=qfgn qiren.gain=2", False),
        ("field=qcolor color.mlp.width=8", "field=qcolor color.mlp.width=16", True),
        ("field=classical color.degree=2", "field=classical color.degree=3", False),
        ("color.directions=raw color.degree=2", "color.directions=raw color.degree=3", True),
        ("encoder=pe hash=C1", "encoder=pe hash=C5", True),
        ("encoder=hash hash=C1", "encoder=hash hash=C5", False),
        ("color=qiren qiren.patterns=2", "color=qiren qiren.patterns=3", True),
        ("qiren.noise.bit_flip=0.1 qiren.patterns=2", "qiren.noise.bit_flip=0.1 qiren.patterns=3", False),
        ("train.log_every=1 store=a threads=1", "train.log_every=2 store=b threads=2", True),
        ("seed=0", "seed=1", False),
        ("train.lr=1", "train.lr=1.0", True),
        ("scene=photograph head=mlp qiren.layers=1", "scene=photograph head=mlp qiren.layers=2", True),
        ("scene=photograph encoder=pe", "scene=photograph encoder=signed", False),
    ):
        first, second = (worked_out(*typed.split()).run_id("scene") for typed in (one, other))
        assert (first == second) is same, (one, other)


EVERY_HEAD = [[f"color={name}", "density=mlp"] for name in HEADS.names()]


def test_acting_of_its_own_result_is_the_same():
    for typed in ([], ["field=qboth"], ["scene=photograph"], ["needs=auto"], *EVERY_HEAD):
        first = worked_out(*typed)
        again = Configuration.of(first.acting)
        assert again.acting == first.acting, typed
        assert again.decisive == first.decisive
        assert set(flatten(again.acting)) <= set(again.types) | {
            name for name in flatten(again.acting) if "noise" in name
        }


def test_acting_has_no_options_of_others():
    names = flatten(worked_out("field=classical").acting)
    assert not [name for name in names if name.startswith(("qiren", "hash", "proposal", "qfgn", "color.qiren", "run"))]
    assert "color.rates.mlp" not in names


def test_a_default_is_not_hashed():
    """So an option that is added later, whose default keeps today's behaviour, changes no id."""
    plain, typed = (worked_out(*typed).decisive for typed in ([], ["color.qiren.statistics=first"]))
    assert typed == plain | {"color.qiren.statistics": "first"}
    assert not set(RECORDED) & set(worked_out("train.log_every=3").decisive)


def test_changed_defaults_and_records_are_named():
    today = worked_out()
    stored = copy.deepcopy(today.complete)
    stored["scene"]["path"] = "elsewhere"
    stored["train"]["log_every"] = 7
    del stored["encoder"]["dense"]  # as in a run that is older than the option
    assert today.differences(Configuration.of(stored)) == {"train.log_every": (7, 10)}
    stored["encoder"]["dense"] = False
    assert today.differences(Configuration.of(stored))["encoder.dense"] == (False, True)


def test_types_of_columns_are_those_of_annotations():
    types = worked_out("train.lr=1", "qiren.noise.bit_flip=0.1").types
    expected = {"seed": "int", "train.lr": "float", "color.qiren.center": "bool", "scene.path": "text"}
    expected |= {"sampler.samples": "text", "color.qiren.shots": "int", "color.qiren.noise.readout": "float"}
    assert {name: types[name] for name in expected} == expected


def test_without_effect_names_what_was_typed_in_vain():
    for typed, named in (
        ("field=qcolor color.directions=raw color.degree=2 color.direction_scale=0.5", ["color.degree=2"]),
        ("field=classical qiren.layers=1 ansatz=rx seed=1", ["qiren.layers=1", "ansatz=rx"]),
        ("field=qcolor qiren.layers=1 ansatz=rx color.qiren.gain=2 color.mlp.width=8", ["color.mlp.width=8"]),
        ("color=qfgn density=mlp qiren.layers=1 color.qiren.gain=2 qfgn.features=8", []),
        ("encoder=pe hash.levels=4 sampler=uniform proposal.final=8", ["hash.levels=4", "proposal.final=8"]),
        ("encoder=hash hash.levels=4 sampler=proposal proposal.final=8 density.rates.mlp=2", []),
        ("scene=photograph head=mlp qiren.layers=1 head.mlp.width=8 head.activation=linear", ["qiren.layers=1"]),
        ("scene=photograph color.degree=2", ["color.degree=2"]),
    ):
        overrides = typed.split()
        assert worked_out(*overrides).without_effect(overrides) == named


def test_a_learning_rate_acts_on_components_with_parameters():
    """Every component is built: one that is `trainable` without parameters, or the reverse, fails here."""
    wiring = {"encoder": (3,), "sampler": (CONTRACTIONS.build("linf"),), "cameras": (2, [0])}
    for group, before in wiring.items():
        for name in COMPONENTS[group].names():
            config = worked_out(f"{group}={name}")
            built = component(COMPONENTS[group], config.complete[group], *before)
            assert (f"train.rates.{group}" in config.types) is bool(list(built.parameters())), (group, name)


def test_a_component_that_denies_its_parameters_is_refused(monkeypatch):
    monkeypatch.setattr(CAMERAS.get("se3"), "trainable", False)
    with pytest.raises(ValueError, match=r"cameras=se3: has parameters; expected `trainable = True`"):
        component(CAMERAS, {"name": "se3"}, 2, [0])


def test_a_configuration_with_a_mistake_is_refused_in_one_line():
    for change, message in (
        ({"extra": 1}, "config: unknown option extra; known: appearance"),
        ({"train": {"steps": 3}}, "train: missing lr"),
        ({"encoder": {"name": "hash", "levles": 3}}, "encoder=hash: unknown option levles=3; known: levels"),
        ({"encoder": {"name": "hsh"}}, "encoder: unknown name 'hsh'; known: hash"),
        ({"color": {"name": "mlp", "mlp": {"widht": 3}}}, r"color.mlp: unknown option widht=3; known: layers"),
        ({"numerics": None}, "numerics must be a group of options, got None"),
        ({"scene": {"name": "photograph"}}, "scene=photograph needs the group head; choose it with scene=photograph"),
    ):
        with pytest.raises(ValueError, match=message) as caught:
            Configuration.of(composed() | change)
        assert "\n" not in str(caught.value)


def after_two_steps(config):
    """All parameters, and the loss of a third step."""
    taken = trainer(config)
    for _ in range(2):
        taken.take_step(measure=False)
    loss = taken.take_step(measure=True)["train/loss"]
    return [*(parameter.detach().clone() for parameter in taken.model.parameters()), torch.tensor(loss)]


WITHOUT_EFFECT = {
    "pose_noise.seed": 3,
    "visibility.resolution": 8,
    "visibility.cameras": None,
    "stop.rays": 7,
    "color.degree": 2,
    "color.mlp.width": 9,
    "density.qiren.layers": 3,
    "density.amplitude.layers": 2,
    "density.amplitude.rotations": "Rot",
    "density.amplitude.frequencies": "ternary",
    "color.qiren.patterns": 1,
    "train.rates.cameras": 7.0,
    "train.rates.appearance": 7.0,
    "train.chunk": 3,
}
"""Options that do not act in the configuration of the test -> another value."""


def test_options_that_do_not_act_change_no_number(tiny):
    config = tiny(
        "density=amplitude", "density.amplitude.unitary=identity", "density.amplitude.registers=[2]", "color=qiren",
        "qiren.qubits=2", "visibility.cameras=0", "train.steps=3",
    )  # fmt: skip
    expected = after_two_steps(config)
    names = {option.name for option in Configuration.of(config).options}
    for name, value in WITHOUT_EFFECT.items():
        if value is None:
            continue
        assert name not in names or name == "train.chunk", name
        *groups, last = name.split(".")
        node = config
        for group in groups:
            node = node.setdefault(group, {})
        node[last] = value
    for one, other in zip(after_two_steps(config), expected, strict=True):
        assert torch.equal(one, other)


HOSTILE = [
    None, True, -1, 0.5, 1e-310, 1e308, float("nan"), float("inf"), 2**63, 10**40, "", "auto", "abc", "a\nb", "a\0b",
    "\ud800", [], {}, [None], [0, -1], [float("nan")], [[[]]], {"name": ["a"]}, {"a": {"b": 1}},
]  # fmt: skip


@functools.cache
def completed(override):
    return worked_out(override).complete


@settings(max_examples=150)
@given(data=st.data(), typed=st.sampled_from(["seed=0", "field=qboth", "scene=photograph", "needs=auto", "color=qvf"]))
def test_a_random_value_is_taken_or_refused_in_one_line(data, typed):
    config = copy.deepcopy(completed(typed))
    option = data.draw(st.sampled_from(Configuration.of(config).options))
    fitting = st.from_type(option.hint) if option.hint is not Any and "Any" not in str(option.hint) else st.none()
    *groups, last = option.name.split(".")
    node = config
    for group in groups:
        node = node.setdefault(group, {})
    node[last] = data.draw(st.sampled_from(HOSTILE) | fitting)
    found, refused = None, ""
    try:
        found = Configuration.of(config)
        found.run_id("scene")
    except ValueError as error:
        refused = f"{type(error).__name__}: {error}"
    assert "\n" not in refused
    assert "Unicode" not in refused.partition(":")[0]
    assert found is None or Configuration.of(found.acting).acting == found.acting
