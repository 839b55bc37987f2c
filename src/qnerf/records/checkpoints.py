"""checkpoint.pt and the one before it, checkpoint.prev.pt."""

import io
import pickle
import textwrap
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from qnerf.records.files import StoreError, open_regular, preserve, replace, reporting


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

        archive = io.BytesIO()
        torch.save(content, archive)
        if not self._was_read_back:  # content that cannot be loaded should fail now, not when the run is resumed
            archive.seek(0)
            try:
                torch.load(archive, weights_only=True)
            except pickle.UnpicklingError as error:
                raise ValueError(f"checkpoint: expected tensors and plain values only: {_shortened(error)}") from error
            self._was_read_back = True
        replace(self.current, archive.getbuffer(), before_rename=self._keep_previous)

    def _keep_previous(self) -> None:
        self._check_owner()
        preserve(self.current, self.previous)

    def load(self, check: Callable[[dict[str, Any]], None]) -> dict[str, Any] | None:
        """The newest checkpoint that can be read and that passes `check`; None if no checkpoint can be read.

        check: raises ValueError if the content does not belong to the run. A checkpoint that is not used is renamed,
        with a warning.

        Raises:
            StoreError: a checkpoint can be read, but it does not belong to the run. All files stay as they are.
        """
        refused: dict[Path, str] = {}
        foreign = False
        content = None
        for path in (self.current, self.previous):
            try:
                loaded = load_archive(path)
            except FileNotFoundError:
                continue
            except OSError as error:
                raise StoreError(f"{path}: cannot read: {error.strerror or error}") from error
            except Exception as error:  # damaged archives raise many kinds of errors
                refused[path] = f"damaged ({type(error).__name__}: {_shortened(error)})"
                continue
            try:
                check(loaded)
            except ValueError as error:
                refused[path] = f"does not fit this run ({_shortened(error)})"
                foreign = True
                continue
            content = loaded
            break
        if content is None and foreign:
            reasons = "; ".join(f"{path}: {reason}" for path, reason in refused.items())
            raise StoreError(f"{reasons}; the run's command with run.force=true does it over")
        onward = "no other checkpoint: starting over" if content is None else "going on from the checkpoint before"
        for path, reason in refused.items():
            aside = path.with_name(f"damaged-{time.time_ns()}-{path.name}")
            self._warn(f"{path}: {reason}; set aside as {aside.name}; {onward}")
            with reporting(path):
                path.rename(aside)
        return content


def load_archive(path: Path) -> dict[str, Any]:
    """The dict that `torch.save` wrote, with tensors on the CPU. Nothing in the file is executed.

    The archive's checksums are compared. Shapes and values of the tensors are for the caller to check.

    Raises:
        Exception: of any kind, if the file is damaged or something else.
    """
    import torch

    with open_regular(path) as file:
        with zipfile.ZipFile(file) as archive:
            if (name := archive.testzip()) is not None:  # torch.load does not compare checksums
                raise zipfile.BadZipFile(f"wrong checksum of {name}")
        file.seek(0)
        content = torch.load(file, map_location="cpu", weights_only=True)
    if not isinstance(content, dict):
        raise pickle.UnpicklingError(f"expected a dict, got {type(content).__name__}")
    return content


def _shortened(error: Exception) -> str:
    return textwrap.shorten(str(error), 200, placeholder="...")
