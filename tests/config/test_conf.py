"""Every choice of every group composes and trains two steps; conf/ and the declarations name the same options."""

import dataclasses
import functools
import itertools
import re

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from qnerf.building.acting import EVERY_SCENE
from qnerf.building.model import build_head
from qnerf.cli.plugins import groups
from qnerf.config.settings import HEAD_GROUPS, Settings
from qnerf.encoders import DIRECTIONS
from qnerf.experiment import run
from qnerf.heads import HEADS, head_options
from qnerf.heads.activations import COLOR_ACTIVATIONS, DENSITY_ACTIVATIONS
from qnerf.quantum.initial_angles import INITS
from qnerf.rendering.spacing import SPACINGS
from tests.config.test_acting import after_two_steps
from tests.helpers.configs import CONF, SWEEPS, TINY, composed, swept, worked_out


def choices(group: str) -> list[str]:
    """What can be named; `auto` is decided by the scene."""
    return sorted(path.stem for path in (CONF / group).glob("*.yaml") if path.stem not in ("_base", "_signal", "auto"))


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
def test_conf_spells_out_every_option_of_a_group(group):
    registry = REGISTRIES[group]
    named = {node_of(group, name)["name"] for name in choices(group)} if group == "head" else choices(group)
    assert sorted(named) == registry.names()
    for name in choices(group):
        node = node_of(group, name)
        if group == "head":
            options = head_options(node)
        elif group == "ansatz":
            options = node["ansatz_options"].get(name, {})
        else:
            options = {key for key in node if key != "name"} - {*EVERY_SCENE * (group == "scene")}
        known = registry.options(node["name"] if group == "head" else name)
        assert set(options) == set(known), f"{group}/{name}.yaml and the signature differ"


def test_conf_and_settings_have_the_same_defaults():
    """Recipes, fields and scenes may set others."""
    config = OmegaConf.to_container(OmegaConf.load(CONF / "config.yaml"))
    for one in dataclasses.fields(Settings):
        declared = HEAD_GROUPS.get(one.name) or one.type
        options = {option.name: option.default for option in dataclasses.fields(declared)} if is_group(declared) else {}
        for name, value in config.get(one.name, {}).items() if options else ():
            assert name not in options or value == options[name] or "${" in str(value), f"{one.name}.{name}"


def is_group(declared: object) -> bool:
    return isinstance(declared, type) and dataclasses.is_dataclass(declared)


@pytest.mark.parametrize("option", VALUES)
def test_comments_in_conf_list_the_names_that_a_value_may_have(option):
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


SMALL = ("qiren.qubits=2",)
TRAINED: dict[str, list[tuple[str, ...]]] = {
    "field": [(f"field={name}", f"encoder={encoder}") for name in choices("field") for encoder in ("hash", "pe")],
    "encoder": [("field=classical", f"encoder={name}") for name in choices("encoder")],
    "qiren": [("field=qboth", f"qiren={name}", *SMALL) for name in ("1L1S", "3L4S")],
    "hash": [(f"hash={name}", "hash.log2_table_size=8", "field=classical") for name in ("C1", "C7")],
    "shading": [
        (f"shading={name}", f"geo_features={features}", f"visibility.cameras={cameras}", *SMALL)
        for name in choices("shading")
        for features, cameras in ((5, 1), (0, 0), (0, 1))
    ],
    "sampler": [(f"sampler={name}", "field=classical") for name in choices("sampler")],
    "cameras": [(f"cameras={name}", "field=classical") for name in choices("cameras")],
    "contraction": [(f"contraction={name}", "field=classical") for name in choices("contraction")],
    "train": [(f"train={name}", "train.rays=8", *SMALL) for name in choices("train") if name != "fit"],
    "needs": [(f"needs={name}", "hash=C7", *SMALL) for name in choices("needs")],
    "budget": [(f"budget={name}", *SMALL) for name in choices("budget")],
    "head": [
        *((f"color={name}", "qiren=1L1S", *SMALL) for name in choices("head")),
        *((f"density={name}", "qiren=1L1S", *SMALL) for name in HEADS.names()),
    ],
    "ansatz": [("field=qboth", f"ansatz={name}", "density.qiren.ansatz=cnot", *SMALL) for name in choices("ansatz")],
    "other": [
        *((f"{group}=auto", "field=classical") for group in ("hash", "cameras", "shading", "contraction")),
        *((f"render.background={name}", "field=classical") for name in ("white", "black", "random", "last_sample")),
        ("stop.every=1", "stop.share=0.2", "field=classical"),
        ("numerics.dtype=float64", "appearance=3", "field=qboth", *SMALL),
    ],
}
"""Group -> overrides of configurations that train."""


@pytest.mark.parametrize("group", TRAINED)
def test_choices_of_a_group_train(tiny, group):
    small = {"sampler=proposal": TINY, "sampler=vanilla": ("sampler.coarse=4", "sampler.fine=4")}
    for overrides in TRAINED[group]:
        extra = small.get(overrides[0], ("sampler.samples=8",)) if group == "sampler" else ()
        assert all(bool(tensor.isfinite().all()) for tensor in after_two_steps(tiny(*overrides, *extra))), overrides


def test_groups_of_conf_are_all_tried():
    tried = {*TRAINED, "hydra", "scene"}  # scenes have tests of their own
    assert {path.name for path in CONF.iterdir() if path.is_dir()} <= tried


def test_jobs_of_every_sweep_are_configurations():
    """The last job of each, as `--sweep NAME` composes it."""
    for name in sorted(path.stem for path in SWEEPS.glob("*.yaml")):
        job = []
        for key, values in swept(name).items():
            parsed = OverridesParser.create().parse_override(f"{key}={values}")
            last = list(parsed.sweep_string_iterator())[-1] if parsed.is_sweep_override() else values
            job.append(f"{key}={last}")
        assert worked_out(*job, "budget=smoke", sweep=name).decisive["train.steps"] == 100


def test_an_ansatz_gets_its_options(tiny):
    config = tiny("ansatz=qiren", "qiren.ansatz_options.qiren.axis=Y", "qiren.ansatz_options.qiren.ranges=[1,2]")
    head = build_head(config["color"], 4, 2)
    assert {gate.name for gate in head.hybrid[0].circuit.circuit.gates} == {"Rot", "CZ", "RY"}


def finished(config) -> dict:
    outcome = run(config)
    assert outcome.state == "finished"
    return outcome.summary


def test_runs_with_shots_and_noise_follow_their_seed(tiny):
    options = ("field=qcolor", "qiren.qubits=2", "qiren.shots=100", "qiren.noise.two_qubit=0.02", "qiren.patterns=2")
    first = finished(tiny(*options))
    again = finished(tiny(*options, "run.force=true"))
    assert (first["color.qiren.shots"], first["color.qiren.noise.two_qubit"]) == (100, 0.02)
    assert first["psnr"] == again["psnr"]
    with pytest.raises(ValueError, match="t2 expects at most 2 t1"):
        build_head(tiny("qiren.noise.t1=1e-5", "qiren.noise.t2=1", "qiren.noise.one_qubit_time=1e-8")["color"], 4, 2)


def test_built_in_scenes_train_and_report_what_they_know(tiny):
    for scene, view_dependent in (("poster", False), ("glossy", True)):
        summary = finished(tiny(f"scene={scene}", "scene.views=6"))
        assert summary["depth_error"] > 0
        parts = [summary["psnr_view_dependent"], summary["psnr_diffuse"]]
        assert all(part is not None and part > 0 for part in parts) if view_dependent else parts == [None, None]
