"""Devices, with GPUs that PyTorch only believes to have."""

import multiprocessing
import tempfile

import pytest
import torch

from qnerf.config import devices


@pytest.fixture
def gpus(monkeypatch, tmp_path):
    """`gpus(2, "cuda")`: this machine has two."""

    def have(count, kind="cuda"):
        monkeypatch.setattr(torch.accelerator, "device_count", lambda: count)
        accelerator = (lambda: torch.device(kind)) if count else _none_as_in_pytorch_2_6
        monkeypatch.setattr(torch.accelerator, "current_accelerator", accelerator)

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(devices, "RETRY", 0.01)
    have(2)
    return have


def _none_as_in_pytorch_2_6():
    raise RuntimeError("Cannot access accelerator device when none is available.")


def test_auto_chooses_the_first_gpu_but_never_mps(gpus):
    assert str(devices.device_of("auto")) == "cuda:0"
    gpus(1, "mps")
    assert str(devices.device_of("auto")) == "cpu"
    assert str(devices.device_of("mps")) == "mps"
    gpus(0)
    assert str(devices.device_of("auto")) == "cpu"


def test_a_device_is_named_as_in_pytorch(gpus):
    names = {"cuda": "cuda", "cuda:1": "cuda:1", "cpu": "cpu", "cpu:0": "cpu"}
    assert {name: str(devices.device_of(name)) for name in names} == names
    for name in ("cuda:2", "tpu", "mps", "", 1, "meta"):
        with pytest.raises(ValueError, match="no such device here; known: auto, cuda:0, cuda:1, cpu"):
            devices.device_of(name)


def test_jobs_side_by_side_get_a_gpu_each_and_the_next_one_waits(gpus):
    told = []
    with devices.dealt("auto", told.append) as first:
        with devices.dealt("auto", told.append) as second:
            assert (first, second, told) == ("cuda:0", "cuda:1", [])
            with devices.dealt("auto", told.append, stopping=lambda: bool(told)) as third:
                assert third == "cuda:0"  # the user stopped it; it ends before its first step
            assert told == ["other jobs have cuda:0, cuda:1; waiting for one. device=cuda:0 would share it"]
        with devices.dealt("auto", told.append) as third:
            assert third == "cuda:1"  # as soon as its job has ended


def test_a_named_gpu_is_shared_and_auto_leaves_it_alone(gpus):
    with devices.dealt("cuda:0", pytest.fail) as first, devices.dealt("cuda:0", pytest.fail) as second:
        assert first == second == "cuda:0"
        with devices.dealt("auto", pytest.fail) as third:
            assert third == "cuda:1"


def _hold(ready, tmp):
    tempfile.tempdir = tmp
    torch.accelerator.device_count = lambda: 2
    torch.accelerator.current_accelerator = lambda: torch.device("cuda")
    with devices.dealt("auto", print) as device:
        ready.send(device)
        ready.recv()


def test_gpus_are_dealt_over_processes_and_a_killed_one_leaves_its_own(gpus, tmp_path):
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    other = context.Process(target=_hold, args=(there, str(tmp_path)))
    other.start()
    assert here.recv() == "cuda:0"
    with devices.dealt("auto", pytest.fail) as own:
        assert own == "cuda:1"
    other.kill()
    other.join()
    with devices.dealt("auto", pytest.fail) as own:
        assert own == "cuda:0"
