"""A configuration that does not fit into memory is refused in one line, before anything is built or written."""

import os
import resource
import subprocess
import sys

import pytest
import torch
from torch import nn

from qnerf.building.acting import settings_of
from qnerf.building.model import build_field_and_sampler
from qnerf.config import memory
from qnerf.experiment import run
from qnerf.model.memory import needed, planned, require_memory
from qnerf.scenes import SCENES
from tests.helpers.configs import ROOT, composed

POSTER = ("scene.views=6", "scene.width=9", "scene.height=16", "scene.supersample=1")


@pytest.fixture(scope="module")
def scene():
    return SCENES.build("poster", views=6, width=9, height=16, supersample=1)


def needs(scene, *overrides):
    settings = settings_of(composed(*overrides))
    parts = planned(lambda: build_field_and_sampler(settings, scene))
    return settings, parts, {need.what: need.size for need in needed(settings, *parts, 144)}


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["train.rays=16000000"], "the samples of a step"),
        (["hash.log2_table_size=30"], "reduce hash.log2_table_size"),
        (["geo_features=65536", "train.rays=100000"], "geometry features"),
        (["field=classical", "color.mlp.width=65536"], "the colour head's parameters"),
        (["appearance=65536", "color.mlp.width=65536", "field=classical"], "parameters"),
    ],
)
def test_what_does_not_fit_is_refused_and_named(scene, monkeypatch, overrides, message):
    monkeypatch.setattr(memory, "available_bytes", lambda: 8 * 2**30)
    settings, parts, _ = needs(scene, *overrides)
    with pytest.raises(ValueError, match=r"would take .* GiB of memory; 8.0 GiB are available; reduce") as error:
        require_memory(settings, *parts, 144)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "overrides", [[], ["field=qboth", "train=paper"], ["field=classical", "hash=C1", "sampler=vanilla", "encoder=pe"]]
)
def test_parameters_are_counted_exactly_and_usual_recipes_fit(scene, monkeypatch, overrides):
    settings, parts, sizes = needs(scene, *overrides)
    field, sampler = build_field_and_sampler(settings, scene)
    built = sum(
        parameter.numel()
        for module in (field, sampler.networks if hasattr(sampler, "networks") else None)
        if module is not None
        for parameter in module.parameters()
    )
    assert sum(size for what, size in sizes.items() if what.endswith("parameters")) == 16 * built
    monkeypatch.setattr(memory, "available_bytes", lambda: 2**30)
    require_memory(settings, *parts, 144)


def test_a_component_that_needs_values_is_not_estimated():
    assert planned(lambda: nn.Linear(2, 2).weight.sum().item()) is None


def test_planning_draws_no_random_numbers(scene):
    torch.manual_seed(3)
    before = torch.get_rng_state()
    needs(scene, "field=qboth")
    assert torch.equal(torch.get_rng_state(), before)


def test_a_refused_configuration_writes_nothing(tmp_path):
    store = tmp_path / "runs"
    with pytest.raises(ValueError, match="would take"):
        run(composed(f"store={store}", "train.rays=16000000", *POSTER))
    assert not store.exists()


@pytest.mark.skipif(sys.platform != "linux", reason="needs ulimit -v")
def test_a_limit_of_the_address_space_is_respected(tmp_path):
    limit = 8 * 2**30
    command = [sys.executable, "-m", "src.run", f"store={tmp_path / 'runs'}", "hash.log2_table_size=26", *POSTER]
    done = subprocess.run(
        command,
        cwd=ROOT,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 2, done.stderr
    assert "would take" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "runs").exists()
