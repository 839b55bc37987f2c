"""checkpoint.pt and the one before it, checkpoint.prev.pt."""

import os
import pickle
import textwrap
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from qnerf.records.files import StoreError, exists, open_plain, preserve, rename, replace, reporting


class Checkpoints:
    """Saves and loads the checkpoints of one run.

    check_owner: called before every write; raises if the run has another owner. warn: takes one line.
    """

    def __init__(self, directory: Path, check_owner: Callable[[], None], warn: Callable[[str], None]) -> None:
        self.current = directory / "checkpoint.pt"
        self.previous = directory / "checkpoint.prev.pt"
        self._check_owner = check_owner
        self._warn = warn
        self._was_read_back = False

    def save(self, content: dict[str, Any]) -> None:
        import torch

        replace(self.current, lambda file: torch.save(content, file), before_rename=self._rotate)

    def _rotate(self, new: Path) -> None:
        if not self._was_read_back:  # content that cannot be loaded should fail now, not when the run is resumed
            try:
                load_archive(new)
            except pickle.UnpicklingError as error:
                raise ValueError(f"checkpoint: expected tensors and plain values only: {_shortened(error)}") from error
            self._was_read_back = True
        self._check_owner()
        preserve(self.current, self.previous)

    def load(self) -> dict[str, Any] | None:
        """The newest checkpoint that can be read. A damaged one is renamed, with a warning."""
        for path in (self.current, self.previous):
            try:
                return load_archive(path)
            except FileNotFoundError:
                continue
            except OSError as error:
                raise StoreError(f"{path}: cannot read: {error.strerror or error}") from error
            except MemoryError:
                raise
            except Exception as error:  # damaged archives raise many kinds of errors
                aside = path.with_name(f"damaged-{time.time_ns()}-{path.name}")
                fallback = path == self.current and exists(self.previous)
                onward = "going on from the checkpoint before" if fallback else "no other checkpoint: starting over"
                reason = f"{type(error).__name__}: {_shortened(error)}"
                self._warn(f"{path}: damaged ({reason}); set aside as {aside.name}; {onward}")
                with reporting(path):
                    rename(path, aside)
        return None


def load_archive(path: Path) -> dict[str, Any]:
    """The dict that `torch.save` wrote, with tensors on the CPU. Nothing in the file is executed.

    Raises:
        Exception: of any kind, if the file is damaged or something else.
    """
    import torch

    with open_plain(path) as file:
        with zipfile.ZipFile(file) as archive:
            size = os.fstat(file.fileno()).st_size
            # torch.save neither compresses nor shares bytes. An archive that unpacks to more than its size is not its.
            if sum(item.file_size for item in archive.infolist()) > size:
                raise zipfile.BadZipFile("it would unpack to more than it holds")
            if (name := archive.testzip()) is not None:  # torch.load does not check the checksums
                raise zipfile.BadZipFile(f"wrong checksum of {name}")
        file.seek(0)
        content = torch.load(file, map_location="cpu", weights_only=True)
    if not isinstance(content, dict):
        raise pickle.UnpicklingError(f"expected a dict, got {type(content).__name__}")
    return content


def _shortened(error: Exception) -> str:
    return textwrap.shorten(str(error), 200, placeholder="...")
