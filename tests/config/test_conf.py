"""Every choice of every group composes, builds and takes two steps; conf/ and the registries name the same things."""

import json

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from qnerf.config.settings import settings_from
from qnerf.encoders import ENCODERS
from qnerf.experiment import run
from qnerf.geometry.contraction import CONTRACTIONS
from qnerf.geometry.pose_refinement import CAMERAS
from qnerf.rendering.samplers import SAMPLERS
from qnerf.rendering.shading import SHADINGS
from qnerf.scenes import SCENES
from tests.helpers.configs import CONF, SWEEPS, TINY, composed, swept
from tests.helpers.scenes import write_scene


def choices(group: str) -> list[str]:
    """What can be named; `auto` is decided by the scene (tests/needs)."""
    return sorted(path.stem for path in (CONF / group).glob("*.yaml") if path.stem not in ("base", "auto"))


REGISTRIES = {"encoder": ENCODERS, "sampler": SAMPLERS, "scene": SCENES, "cameras": CAMERAS, "gate": SHADINGS}


@pytest.mark.parametrize("group", REGISTRIES)
def test_conf_and_registry_name_the_same_choices(group):
    assert choices(group) == REGISTRIES[group].names()


@pytest.mark.parametrize("group", REGISTRIES)
def test_conf_spells_out_every_option(group):
    for name in choices(group):
        path = ["scene.path=x"] if group == "scene" else []
        node = composed(f"{group}={name}", *path)[group]
        known = set(REGISTRIES[group].options(name))
        assert set(node) - {"name"} == known, f"{group}/{name}.yaml and the signature differ"


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


@pytest.mark.parametrize("gate", choices("gate"))
def test_every_gate_trains(tiny, gate):
    assert finished(tiny("field=qcolor", "qiren.qubits=2", f"shading={gate}"))["gate"] == gate


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


@pytest.mark.parametrize("group", ["hash", "cameras", "gate"])
def test_auto_of_one_group_trains(tiny, group):
    summary = finished(tiny("field=classical", f"{group}=auto", "visibility.resolution=16"))
    assert any(column.startswith(f"needs.{group}.") for column in summary)


def test_the_options_of_an_occupancy_and_of_a_stop_train(tiny):
    options = ("occupancy.every=1", "occupancy.after=0", "stop.every=1", "stop.share=0.2", "visibility.resolution=16")
    finished(tiny("field=classical", *options))


@pytest.mark.parametrize("train", choices("train"))
def test_every_recipe_trains(tiny, train):
    assert finished(tiny(f"train={train}"))["train"] == train


@pytest.mark.parametrize("name", choices("experiment"))
def test_every_experiment_trains(tiny, name):
    assert finished(tiny(f"experiment={name}"))["experiment"] == name


@pytest.mark.parametrize("name", sorted(path.stem for path in SWEEPS.glob("*.yaml")))
def test_every_job_of_every_sweep_is_a_configuration(name):
    """Composed as `-cd sweeps -cn name` composes it, with each value of each parameter, and checked."""
    parameters = swept(name)
    assert parameters
    for key, values in parameters.items():
        parsed = OverridesParser.create().parse_override(f"{key}={values}")
        for value in parsed.sweep_string_iterator() if parsed.is_sweep_override() else [values]:
            assert settings_from(composed(f"{key}={value}", "budget=smoke", sweep=name)).train.steps == 100


@pytest.mark.parametrize("contraction", CONTRACTIONS.names())
def test_every_contraction_trains(tiny, contraction):
    finished(tiny("field=classical", f"contraction.name={contraction}", "visibility.cameras=0"))


@pytest.mark.parametrize("name", ["qfgn", "mlp", "qiren"])
def test_every_head_kind_trains(tiny, name):
    finished(tiny(f"color.name={name}", "color.directions=sh"))


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


def test_float64_and_appearance_train(tiny):
    finished(tiny("numerics.dtype=float64", "appearance=3", "field=qboth"))
