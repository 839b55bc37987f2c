"""checkpoint.pt and the one before it."""

import os
import pickle
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from qnerf.records.files import StoreError, keep_copy, open_plain, replace, reporting


class Checkpoints:
    """`guard` is called before every write and raises when writing is not ours any more; `warn` takes one line."""

    def __init__(self, directory: Path, guard: Callable[[], None], warn: Callable[[str], None]) -> None:
        self.current = directory / "checkpoint.pt"
        self.previous = directory / "checkpoint.prev.pt"
        self._guard = guard
        self._warn = warn
        self._proven = False

    def save(self, content: dict[str, Any]) -> None:
        import torch

        replace(
            self.current,
            lambda sink: torch.save(content, sink),
            check=None if self._proven else _prove,
            before=self._rotate,
        )
        self._proven = True

    def _rotate(self) -> None:
        self._guard()
        keep_copy(self.current, self.previous)

    def load(self) -> dict[str, Any] | None:
        for path in (self.current, self.previous):
            try:
                return load_archive(path)
            except FileNotFoundError:
                continue
            except OSError as error:
                raise StoreError(f"{path}: cannot read: {error.strerror or error}") from error
            except MemoryError:
                raise
            except Exception as error:  # whatever a damaged archive makes its readers raise
                aside = path.with_name(f"damaged-{time.time_ns()}-{path.name}")
                fallback = path == self.current and self.previous.exists()
                onward = "going on from the checkpoint before" if fallback else "no other checkpoint: starting over"
                reason = f"{type(error).__name__}: {_line(error)}"
                self._warn(f"{path}: damaged ({reason}); set aside as {aside.name}; {onward}")
                with reporting(path):
                    os.replace(path, aside)
        return None


def load_archive(path: Path) -> dict[str, Any]:
    """The tensors that `torch.save` wrote; raises whatever a file that is something else makes its readers raise."""
    import torch

    with open_plain(path) as file:
        with zipfile.ZipFile(file) as archive:
            size = os.fstat(file.fileno()).st_size
            # torch.save neither compresses nor shares bytes: what would unpack to more than the file is not its work.
            if sum(item.file_size for item in archive.infolist()) > size:
                raise zipfile.BadZipFile("it would unpack to more than it holds")
            if (bad := archive.testzip()) is not None:  # torch.load itself does not look at the checksums
                raise zipfile.BadZipFile(f"wrong checksum of {bad}")
        file.seek(0)
        content = torch.load(file, map_location="cpu", weights_only=True)
    if not isinstance(content, dict):
        raise pickle.UnpicklingError(f"expected a dict, got {type(content).__name__}")
    return content


def _prove(path: Path) -> None:
    """What cannot be read back should fail now, not when the run is resumed."""
    try:
        load_archive(path)
    except pickle.UnpicklingError as error:
        raise ValueError(f"checkpoint: expected tensors and plain values only: {_line(error)}") from error


def _line(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= 200 else f"{text[:200]}..."
