"""Compiling with two processes on first use: building/first_use.py."""

import io
import json
import subprocess

import pytest
import torch

from qnerf.building import first_use
from qnerf.building.model import build_model
from qnerf.building.scene import prepare
from qnerf.training.trainer import Trainer
from tests.helpers.configs import composed

SMALL = ("budget=smoke", "scene.views=12", "scene.width=8", "scene.height=8", "scene.supersample=1", "device=cpu")


@pytest.fixture
def new(monkeypatch):
    """As in an environment where nothing has been compiled."""
    torch.set_num_threads(2)
    monkeypatch.setattr(first_use, "keeps", lambda kernel: True)
    monkeypatch.setattr(first_use, "is_cached", lambda kernel: False)


@pytest.fixture
def started(monkeypatch):
    """The second processes that were started."""
    processes = []

    class Process(subprocess.Popen):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            processes.append(self)

    monkeypatch.setattr(subprocess, "Popen", Process)
    return processes


def model_of(config):
    _, settings, scene = prepare(config)
    return build_model(settings, scene)


def test_the_second_process_ends_well(new, started):
    config = composed("field=qcolor", *SMALL)
    with first_use.two_processes(config) as finish:
        finish(model_of(config))
        assert started[0].poll() == 0


@pytest.mark.parametrize("field", ["qcolor", "qdensity", "qboth", "classical"])
def test_it_takes_a_step_without_circuits(field, monkeypatch):
    trained = []
    take_step = Trainer.take_step
    monkeypatch.setattr(Trainer, "take_step", lambda self, measure: trained.append(self) or take_step(self, measure))
    monkeypatch.setattr("sys.stdin", io.StringIO(json.dumps(composed(f"field={field}", "device=cpu"))))
    first_use.main()
    assert [trainer.step for trainer in trained] == [1]
    assert not any(isinstance(module, first_use.QuantumLayer) for module in trained[0].model.modules())


def test_compiling_circuits_changes_nothing(monkeypatch):
    ran = []
    forward = first_use.QuantumLayer.forward
    monkeypatch.setattr(first_use.QuantumLayer, "forward", lambda self, x: ran.append(x.dtype) or forward(self, x))
    model = model_of(composed("field=qboth", *SMALL))
    before, random = {k: v.clone() for k, v in model.state_dict().items()}, torch.get_rng_state()
    ran.clear()
    first_use.compile_circuits(model)
    assert ran == [torch.float32] * 4
    assert all(torch.equal(v, before[k]) for k, v in model.state_dict().items())
    assert all(p.grad is None for p in model.parameters())
    assert torch.equal(torch.get_rng_state(), random)


def test_a_second_process_that_fails_is_ignored(new, started, monkeypatch):
    config = composed("field=qcolor", *SMALL)
    monkeypatch.setattr(first_use.json, "dumps", lambda value: "no configuration")
    with first_use.two_processes(config) as finish:
        finish(model_of(config))
    assert started[0].returncode == 1


def test_it_does_not_outlive_an_error(new, started):
    with pytest.raises(ValueError, match="no scene"), first_use.two_processes(composed("field=qcolor", *SMALL)):
        raise ValueError("no scene")
    assert started[0].returncode is not None


@pytest.mark.parametrize("problem", ["", "/nonexistent/python"])
def test_a_process_that_cannot_start_is_ignored(problem, new, monkeypatch):
    monkeypatch.setattr("sys.executable", problem)
    with first_use.two_processes(composed("field=qcolor", *SMALL)) as finish:
        finish(None)


@pytest.mark.parametrize("key", ["color", "encoder", "device", "plugins"])
@pytest.mark.parametrize("value", [None, 5, "text", []])
def test_mistakes_are_left_to_their_own_messages(key, value, new):
    with first_use.two_processes(composed("field=qdensity", *SMALL) | {key: value}):
        pass


@pytest.mark.parametrize(
    "override",
    [
        "field=classical", "threads=1", "device=cuda", "plugins=[other]", "encoder=pe", "sampler=uniform",
        "color.qiren.shots=100", "qiren.noise.bit_flip=0.01", "color.qiren.method=pennylane", "color=amplitude",
    ],
)  # fmt: skip
def test_other_configurations_have_one_process(override, new, started):
    with first_use.two_processes(composed("field=qcolor", *SMALL, override)):
        pass
    assert not started


@pytest.mark.parametrize("why", ["cached", "not kept", "one thread"])
def test_one_process_is_enough(why, new, started, monkeypatch):
    if why == "cached":
        monkeypatch.setattr(first_use, "is_cached", lambda kernel: True)
    elif why == "not kept":
        monkeypatch.setattr(first_use, "keeps", lambda kernel: False)
    else:
        torch.set_num_threads(1)
    with first_use.two_processes(composed("field=qcolor", *SMALL)):
        pass
    assert not started
