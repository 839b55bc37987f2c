"""Every choice of every group composes, builds and takes two steps; conf/ and the registries name the same things."""

import functools
import itertools
import json
import re

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from qnerf.building.model import build_head
from qnerf.cli.plugins import groups
from qnerf.config.compatibility import ADDED, neutral
from qnerf.config.settings import check_settings, only_acting
from qnerf.encoders import DIRECTIONS
from qnerf.experiment import run
from qnerf.heads import HEADS, head_options
from qnerf.heads.activations import COLOR_ACTIVATIONS, DENSITY_ACTIVATIONS
from qnerf.model.labels import labels
from qnerf.quantum.circuit import Encoding
from qnerf.quantum.initial_angles import INITS
from qnerf.rendering.spacing import SPACINGS
from tests.helpers.configs import CONF, SWEEPS, TINY, composed, swept
from tests.helpers.scenes import write_scene


def choices(group: str) -> list[str]:
    """What can be named; `auto` is decided by the scene (tests/needs)."""
    return sorted(path.stem for path in (CONF / group).glob("*.yaml") if path.stem not in ("base", "auto"))


REGISTRIES = dict(groups())
VALUES = {
    "color.directions": DIRECTIONS,
    "color.activation": COLOR_ACTIVATIONS,
    "density.activation": DENSITY_ACTIVATIONS,
    "qiren.init": INITS,
    "sampler.spacing": SPACINGS,
}
"""Option -> the registry that its value names a component of."""


@functools.cache
def node_of(group: str, name: str) -> dict:
    """The part of the configuration that `group=name` sets."""
    path = ["scene.path=x"] if name in ("blender", "nerfstudio") else []
    key, part = {"head": ("head@color", "color"), "ansatz": ("ansatz", "qiren")}.get(group, (group, group))
    return composed(f"{key}={name}", *path)[part]


@pytest.mark.parametrize("group", REGISTRIES)
def test_conf_and_registry_name_the_same_choices(group):
    named = {node_of(group, name)["name"] for name in choices(group)} if group == "head" else choices(group)
    assert sorted(named) == REGISTRIES[group].names()
    assert set(named) <= set(choices(group))


@pytest.mark.parametrize(("group", "name"), [(group, name) for group in REGISTRIES for name in choices(group)])
def test_conf_spells_out_every_option(group, name):
    node = node_of(group, name)
    known = set(REGISTRIES[group].options(node["name"] if group == "head" else name))
    if group == "head":
        options, chosen = head_options(node), node["name"]
        name = name if name in REGISTRIES[group].names() else chosen  # else a head with other defaults
    elif group == "ansatz":
        options, chosen = node["ansatz_options"].get(name, {}), node["ansatz"]
    else:
        options, chosen = {key: value for key, value in node.items() if key != "name"}, node["name"]
    assert chosen == name
    assert set(options) == known, f"{group}/{name}.yaml and the signature differ"


@pytest.mark.parametrize("option", VALUES)
def test_a_comment_in_conf_lists_the_names_that_a_value_may_have(option):
    """`spacing: piecewise  # piecewise | uniform | ...`; what follows a name after a colon explains it."""
    group, _, key = option.rpartition(".")
    files = [CONF / "config.yaml", *sorted((CONF / group).glob("*.yaml"))]
    lines = [line for file in files for line in file.read_text().splitlines()]
    if f"{group}:" in lines:  # of config.yaml: the lines of the option's own group
        lines = lines[lines.index(f"{group}:") + 1 :]
        lines = list(itertools.takewhile(lambda line: line.startswith(("  ", "#")) or not line, lines))
    comments = [match[1] for line in lines if (match := re.fullmatch(rf" *{key}: [^#]+# (.* \| .*)", line))]
    assert comments
    for comment in comments:
        assert sorted(comment.partition(":")[0].split(" | ")) == VALUES[option].names()


def test_added_options_change_nothing_by_default():
    """Else today's runs would have other ids than the runs of the same command before."""
    seen = set()
    for scene in ("poster", "nerfstudio", "blender"):
        config = composed(f"scene={scene}", *(["scene.path=x"] if scene != "poster" else []))
        values = neutral(config)
        assert {option: value_at(config, option) for option in values} == values
        seen |= set(values)
    assert seen == set(ADDED)


def value_at(config: dict, option: str) -> object:
    for key in option.split("."):
        config = config[key]
    return config


def finished(config) -> dict:
    outcome = run(config)
    assert outcome.state == "finished"
    assert outcome.summary["psnr"] > 0
    return outcome.summary


@pytest.mark.parametrize("field", choices("field"))
@pytest.mark.parametrize("encoder", choices("encoder"))
def test_every_field_trains_with_every_encoder(tiny, field, encoder):
    summary = finished(tiny(f"field={field}", f"encoder={encoder}"))
    assert (summary["field"], summary["encoder"]) == (field, encoder)


@pytest.mark.parametrize("qiren", choices("qiren"))
def test_every_qiren_trains(tiny, qiren):
    assert finished(tiny("field=qboth", f"qiren={qiren}"))["qiren"] == qiren


@pytest.mark.parametrize("table", choices("hash"))
def test_every_hash_table_trains(tiny, table):
    if table in ("C1", "C2"):
        table, overrides = table, [f"hash={table}", "hash.log2_table_size=12"]
        finished(tiny("field=classical", *overrides))
    else:
        assert finished(tiny("field=classical", f"hash={table}"))["hash"] == table


@pytest.mark.parametrize("shading", choices("shading"))
def test_every_shading_trains(tiny, shading):
    assert finished(tiny("field=qcolor", "qiren.qubits=2", f"shading={shading}"))["shading"] == shading


@pytest.mark.parametrize("sampler", choices("sampler"))
def test_every_sampler_trains(tiny, sampler):
    small = {"proposal": TINY, "vanilla": ("sampler.coarse=4", "sampler.fine=4")}.get(sampler, ("sampler.samples=8",))
    assert finished(tiny("field=classical", f"sampler={sampler}", *small))["sampler"] == sampler


@pytest.mark.parametrize("cameras", choices("cameras"))
def test_every_camera_refinement_trains(tiny, cameras):
    summary = finished(tiny("field=classical", f"cameras={cameras}"))
    assert (summary["params.cameras"] > 0) == (cameras != "fixed")


@pytest.mark.parametrize("needs", ["auto", "full", "none"])
def test_every_way_to_say_what_a_scene_needs_trains(tiny, needs):
    """Small tables by hand: what is set wins."""
    assert finished(tiny(f"needs={needs}", "hash=C7", "visibility.resolution=16"))["hash"] == "C7"


@pytest.mark.parametrize("group", ["hash", "cameras", "shading", "contraction"])
def test_auto_of_one_group_trains(tiny, group):
    summary = finished(tiny("field=classical", f"{group}=auto", "visibility.resolution=16"))
    assert any(column.startswith(f"needs.{group}.") for column in summary)


def test_the_options_of_an_occupancy_and_of_a_stop_train(tiny):
    options = ("occupancy.every=1", "occupancy.after=0", "stop.every=1", "stop.share=0.2", "visibility.resolution=16")
    finished(tiny("field=classical", *options))


@pytest.mark.parametrize("train", [name for name in choices("train") if name != "fit"])  # tests/signals has fit
def test_every_recipe_trains(tiny, train):
    assert finished(tiny(f"train={train}"))["train"] == train


@pytest.mark.parametrize("name", choices("experiment"))
def test_every_experiment_trains(tiny, name):
    assert finished(tiny(f"experiment={name}"))["experiment"] == name


@pytest.mark.parametrize("name", sorted(path.stem for path in SWEEPS.glob("*.yaml")))
def test_every_job_of_every_sweep_is_a_configuration(name):
    """Jobs as `-cd sweeps -cn name` composes them, in which each value of each parameter comes at least once.

    Of the experiments, which all train in a test of their own, the first one.
    """
    parameters = swept(name)
    assert parameters
    several = {}
    for key, values in parameters.items():
        parsed = OverridesParser.create().parse_override(f"{key}={values}")
        named = list(parsed.sweep_string_iterator()) if parsed.is_sweep_override() else [values]
        if key == "experiment":
            assert set(named) <= set(choices("experiment"))
        elif key == "seed":
            assert all(value.isdecimal() for value in named)
        several[key] = named[:1] if key in ("experiment", "seed") else named
    for number in range(max(map(len, several.values()))):
        job = (f"{key}={named[min(number, len(named) - 1)]}" for key, named in several.items())
        config = only_acting(composed(*job, "budget=smoke", sweep=name))
        check_settings(config)
        assert config["train"]["steps"] == 100


@pytest.mark.parametrize("key", ["contraction", "contraction.name"])
@pytest.mark.parametrize("contraction", choices("contraction"))
def test_every_contraction_trains(tiny, key, contraction):
    finished(tiny("field=classical", f"{key}={contraction}", "visibility.cameras=0"))


@pytest.mark.parametrize("name", HEADS.names())
@pytest.mark.parametrize("key", ["color", "color.name", "density"])
def test_every_head_trains(tiny, name, key):
    summary = finished(tiny(f"{key}={name}", "color.directions=sh", "qiren=1L1S", "qiren.qubits=2"))
    assert summary[f"{key.partition('.')[0]}.name"] == name


@pytest.mark.parametrize("name", sorted({*choices("head")} - {*HEADS.names()}))
def test_every_head_with_other_defaults_trains(tiny, name):
    summary = finished(tiny(f"color={name}", "color.directions=raw"))
    assert summary["color"] != labels(composed(f"color={summary['color.name']}"))["color"]


@pytest.mark.parametrize("ansatz", choices("ansatz"))
def test_every_ansatz_trains(tiny, ansatz):
    """The color head sees the group's choice; the density head's is set by value."""
    summary = finished(tiny("field=qboth", "qiren.qubits=2", f"ansatz={ansatz}", "density.qiren.ansatz=cnot"))
    assert (summary["color.qiren.ansatz"], summary["density.qiren.ansatz"]) == (ansatz, "cnot")


def test_the_options_of_an_ansatz_reach_its_circuits(tiny):
    config = tiny("ansatz=qiren", "qiren.ansatz_options.qiren.axis=Y", "qiren.ansatz_options.qiren.ranges=[1,2]")
    head = build_head(config["color"], 4, 2)
    assert {op.axis for op in head.hybrid[0].circuit.circuit.operations if isinstance(op, Encoding)} == {"Y"}


def test_a_run_trains_with_shots_and_noise_that_follow_its_seed(tiny):
    options = ("field=qcolor", "qiren.qubits=2", "qiren.shots=100", "qiren.noise.two_qubit=0.02", "qiren.patterns=2")
    first = finished(tiny(*options))
    again = finished(tiny(*options, "run.force=true"))
    assert (first["qiren.shots"], first["qiren.noise.two_qubit"]) == (100, 0.02)
    assert first["psnr"] == again["psnr"]
    with pytest.raises(ValueError, match="t2 expects at most 2 t1"):
        build_head(tiny("qiren.noise.t1=1e-5", "qiren.noise.t2=1", "qiren.noise.one_qubit_time=1e-8")["color"], 4, 2)


@pytest.mark.parametrize("background", ["white", "black", "random", "last_sample"])
def test_every_background_trains(tiny, background):
    finished(tiny("field=classical", f"render.background={background}"))


def test_the_poster_trains(tiny):
    summary = finished(tiny("scene=poster", "scene.views=6", "scene.width=9", "scene.height=16", "scene.supersample=1"))
    assert summary["depth_error"] > 0


def test_a_blender_scene_trains(tiny, tmp_path):
    folder = write_scene(tmp_path / "blender", channels=4)
    transforms = json.loads((folder / "transforms.json").read_text())
    transforms["camera_angle_x"] = 0.9
    for split, part in (("train", slice(0, 4)), ("test", slice(4, 6)), ("val", slice(4, 6))):
        frames = [
            dict(frame, file_path=frame["file_path"].removesuffix(".png")) for frame in transforms["frames"][part]
        ]
        (folder / f"transforms_{split}.json").write_text(json.dumps(transforms | {"frames": frames}))
    summary = finished(tiny("scene=blender", f"scene.path={folder}"))
    assert summary["scene"] == "blender"


@pytest.mark.parametrize("shading", choices("shading"))
@pytest.mark.parametrize("cameras", [0, 1])
def test_a_field_without_geometry_features_trains(tiny, shading, cameras):
    options = ("geo_features=0", f"shading={shading}", f"visibility.cameras={cameras}", "visibility.resolution=16")
    finished(tiny("field=qcolor", "qiren.qubits=2", *options))


def test_float64_and_appearance_train(tiny):
    finished(tiny("numerics.dtype=float64", "appearance=3", "field=qboth"))
