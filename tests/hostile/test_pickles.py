"""Checkpoints from elsewhere: nothing in them is executed, none fills the memory, the one before is used instead."""

import io
import logging
import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from qnerf.config import memory
from qnerf.records.checkpoints import load_archive
from qnerf.records.tensor_bounds import check_bounds
from tests.helpers.spoiled import interrupted, started, store


class Command:
    """Unpickling it runs a shell command."""

    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (self.command,)


class Evaluated(Command):
    def __reduce__(self) -> tuple[Any, ...]:
        return eval, (f"__import__('os').system({self.command!r})",)


def saved(content: object) -> bytes:
    data = io.BytesIO()
    torch.save(content, data)
    return data.getvalue()


def legacy(content: object) -> bytes:
    data = io.BytesIO()
    torch.save(content, data, _use_new_zipfile_serialization=False)
    return data.getvalue()


def compressed(_: object) -> bytes:
    """A gigabyte of zeros in a megabyte: the archive of torch.save, but deflated."""
    whole = zipfile.ZipFile(io.BytesIO(saved({"step": 3, "x": torch.zeros(10)})))
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        for item in whole.infolist():
            if item.filename.endswith("data/0"):
                with archive.open(item.filename, "w") as sink:
                    for _block in range(64):
                        sink.write(bytes(2**20))
            else:
                archive.writestr(item.filename, whole.read(item))
    return data.getvalue()


def shared(_: object) -> bytes:
    """A thousand directory entries for the same bytes."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        archive.writestr("a/data/0", bytes(10_000))
        first = archive.filelist[0]
        for number in range(1, 1000):
            copy = zipfile.ZipInfo(f"a/data/{number}")
            for name in ("header_offset", "CRC", "compress_size", "file_size"):
                setattr(copy, name, getattr(first, name))
            archive.filelist.append(copy)
        archive._didModify = True  # type: ignore[attr-defined]
    return data.getvalue()


def edited(old: bytes, new: bytes, file: str = "data.pkl") -> bytes:
    """A checkpoint with a tensor of four numbers, in which one of the archive's files is changed."""
    whole = zipfile.ZipFile(io.BytesIO(saved({"step": 3, "x": torch.arange(4.0)})))
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        for item in whole.infolist():
            content = whole.read(item)
            if item.filename.endswith(file):
                assert old in content
                content = content.replace(old, new)
            archive.writestr(item.filename, content)
    return data.getvalue()


FOUR, MANY = b"K\x04", b"M\x00\x10"  # pickled integers
LYING: list[Callable[[str], bytes]] = [
    lambda _: edited(FOUR, MANY),  # storage and shape
    lambda _: edited(FOUR + b"t", MANY + b"t"),  # the storage
    lambda _: edited(FOUR + b"\x85", MANY + b"\x85"),  # the shape
    lambda _: edited(b"K\x01\x85", MANY + b"\x85"),  # the stride
    lambda _: edited(b"QK\x00", b"Q" + MANY),  # the offset
    lambda _: edited(b"FloatStorage", b"DoubleStorage"),
    lambda _: edited(bytes(4), b"", "data/0"),  # fewer bytes than the tensor has
    lambda _: edited(b"u.", b"(K\x00K\x01uu."),  # writes into the tensor
    lambda _: b"before" + edited(b"", b""),
    lambda _: edited(b"", b"", "nothing").replace(b"/version", b"/BYTEORDER"),  # twice the same name, but for case
]


@pytest.mark.parametrize(
    "made",
    [
        lambda command: saved({"step": 3, "x": Command(command)}),
        lambda command: saved({"step": 3, "x": Evaluated(command)}),
        lambda command: saved(Command(command)),
        lambda command: legacy({"step": 3, "x": Command(command)}),
        lambda command: pickle.dumps(Command(command)),
        compressed,
        shared,
        lambda _: saved([1, 2]),
        lambda _: saved({"step": 3, "x": type("Own", (), {"__reduce__": lambda self: (open, ("/dev/zero",))})()}),
        *LYING,
    ],
)
def test_a_hostile_checkpoint_is_set_aside(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, made: Callable[[str], bytes]
) -> None:
    run = interrupted(tmp_path)
    (run / "checkpoint.pt").write_bytes(made(f"touch {tmp_path / 'owned'}"))
    claim = store(tmp_path).claim("a", {})
    assert claim.run is not None
    with caplog.at_level(logging.WARNING):
        content = claim.run.load_checkpoint()
    assert content == {"step": 8}
    assert not (tmp_path / "owned").exists()
    (message,) = caplog.messages
    assert "damaged" in message
    assert "going on from the checkpoint before" in message
    assert "\n" not in message
    claim.run.interrupt()


@pytest.mark.parametrize("made", LYING)
def test_sizes_that_lie_are_found_before_pytorch_reads_them(tmp_path: Path, made: Callable[[str], bytes]) -> None:
    """Some versions of PyTorch would make a tensor of memory that does not belong to it."""
    data = made("")
    with pytest.raises((pickle.UnpicklingError, zipfile.BadZipFile, TypeError)):
        check_bounds(zipfile.ZipFile(io.BytesIO(data)))


def test_true_sizes_pass() -> None:
    odd = {"scalar": torch.tensor(2), "empty": torch.empty(0, 3), "turned": torch.rand(3, 4).t()[1:]}
    rest = {"none": None, "large": 10**30, "nested": [1.5, (True, "text")], "state": torch.nn.Linear(3, 2).state_dict()}
    check_bounds(zipfile.ZipFile(io.BytesIO(saved(odd | rest))))


def test_a_checkpoint_larger_than_that_of_the_run_is_not_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run = interrupted(tmp_path)
    (run / "checkpoint.pt").write_bytes(saved({"step": 3, "x": torch.zeros(2**18)}))
    claim = store(tmp_path).claim("a", {})
    assert claim.run is not None
    with caplog.at_level(logging.WARNING):
        assert claim.run.load_checkpoint(max_bytes=2**20) == {"step": 8}
    assert "larger than the 1,048,576 bytes" in caplog.messages[0]
    claim.run.interrupt()


def test_a_file_that_does_not_fit_in_memory_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = interrupted(tmp_path)
    monkeypatch.setattr(memory, "available_bytes", lambda: 100)
    with pytest.raises(MemoryError, match="not enough memory for a checkpoint of"):
        load_archive(run / "checkpoint.pt")


@pytest.mark.parametrize("kind", ["link", "pipe", "folder"])
def test_what_is_no_file_is_set_aside(tmp_path: Path, caplog: pytest.LogCaptureFixture, kind: str) -> None:
    run = interrupted(tmp_path)
    path = run / "checkpoint.pt"
    path.rename(tmp_path / "elsewhere.pt")
    if kind == "link":
        path.symlink_to(tmp_path / "elsewhere.pt")
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        path.mkdir()
    claim = store(tmp_path).claim("a", {})
    assert claim.run is not None
    with caplog.at_level(logging.WARNING):
        content = claim.run.load_checkpoint()
    assert content == {"step": 8}
    assert len(caplog.messages) == 1
    claim.run.save_checkpoint({"step": 9})
    assert torch.load(path, weights_only=True) == {"step": 9}
    assert torch.load(tmp_path / "elsewhere.pt", weights_only=True) == {"step": 9}  # the earlier one, untouched
    claim.run.finish()


def test_only_plain_values_are_written(tmp_path: Path) -> None:
    run = started(tmp_path)
    with pytest.raises(ValueError, match="checkpoint: expected tensors and plain values only"):
        run.save_checkpoint({"x": Command(f"touch {tmp_path / 'owned'}")})
    assert not (tmp_path / "owned").exists()
    run.finish()
