"""Where what can be made again is kept."""

import contextlib
import os
from pathlib import Path


def cache_folder() -> Path | None:
    """$QNERF_CACHE, else $XDG_CACHE_HOME/qnerf, else ~/.cache/qnerf; None where there is no home to keep it in."""
    own, base = os.environ.get("QNERF_CACHE"), os.environ.get("XDG_CACHE_HOME")
    with contextlib.suppress(RuntimeError):  # no home folder
        return Path(own).expanduser() if own else Path(base or "~/.cache").expanduser() / "qnerf"
    return None
