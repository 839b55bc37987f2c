"""checkpoint.pt and the one before it, checkpoint.prev.pt."""

import io
import os
import pickle
import re
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from qnerf.records.files import StoreError, one_line, reading, replace, reporting


class Checkpoints:
    """Saves and loads the checkpoints of one run.

    check_owner: called before every write; raises if the run has another owner. warn: takes one line.
    """

    def __init__(self, directory: Path, check_owner: Callable[[], None], warn: Callable[[str], None]) -> None:
        self.current = directory / "checkpoint.pt"
        self.previous = directory / "checkpoint.prev.pt"
        self._check_owner = check_owner
        self._warn = warn

    def save(self, content: dict[str, Any]) -> None:
        import torch

        archive = io.BytesIO()
        try:
            torch.save(content, archive)
            archive.seek(0)
            torch.load(archive, weights_only=True)  # what cannot be loaded fails now, not when the run is resumed
        except (pickle.PickleError, AttributeError, TypeError, RecursionError) as error:
            known = re.search(r"GLOBAL (\S+)", str(error))
            raise ValueError(
                f"checkpoint: expected tensors and plain values only, got {known[1] if known else one_line(error)};"
                " give a module's state_dict(), torch.as_tensor() of an array"
            ) from error
        replace(self.current, archive.getbuffer(), before_rename=self._keep_previous)

    def _keep_previous(self) -> None:
        """Makes the current checkpoint the previous one. At every moment one of the two files is whole."""
        self._check_owner()
        if not self.current.exists():
            return
        self.previous.unlink(missing_ok=True)
        try:
            os.link(self.current, self.previous)  # the current one stays until the new one replaces it
        except OSError:  # this file system has no hard links
            os.replace(self.current, self.previous)

    def load(self, check: Callable[[dict[str, Any]], None]) -> dict[str, Any] | None:
        """The newest checkpoint that can be read; None if none can. A damaged one is renamed, with a warning.

        check: raises ValueError if the content does not belong to the run, or stumbles over what it does not expect.

        Raises:
            StoreError: the checkpoint does not belong to the run. All files stay as they are.
        """
        for path in (self.current, self.previous):
            try:
                content = load_archive(path)
                check(content)
            except FileNotFoundError:
                continue
            except OSError as error:
                raise StoreError(f"{path}: cannot read: {error.strerror or error}") from error
            except StoreError as error:
                aside = path.with_name(f"damaged-{time.time_ns()}-{path.name}")
                with reporting(path):
                    path.rename(aside)
                self._warn(f"{error}; set aside as {aside.name}; {self._onward(path)}")
            except (ValueError, LookupError, TypeError, AttributeError) as error:
                advice = "delete it to try the checkpoint before, or do the run over with run.force=true"
                raise StoreError(f"{path}: does not fit this run ({one_line(error)}); {advice}") from error
            else:
                return content
        return None

    def _onward(self, damaged: Path) -> str:
        if damaged == self.current and self.previous.exists():
            return "going on from the checkpoint before"
        return "no other checkpoint: starting over"


def load_archive(path: Path) -> dict[str, Any]:
    """The dict that `torch.save` wrote, with tensors on the CPU. Nothing in the file is executed.

    The archive's checksums are compared. Shapes and values of the tensors are for the caller to check.

    Raises:
        StoreError: the file is damaged or something else.
        OSError: it cannot be read.
    """
    import torch

    with open(path, "rb") as file, reading(path):
        with zipfile.ZipFile(file) as archive:
            if (name := archive.testzip()) is not None:  # torch.load does not compare checksums
                raise ValueError(f"wrong checksum of {name}")
        file.seek(0)
        content = torch.load(file, map_location="cpu", weights_only=True)
        if not isinstance(content, dict):
            raise ValueError(f"expected a dict, got {type(content).__name__}")
    return content
