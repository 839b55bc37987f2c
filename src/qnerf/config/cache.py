"""Location of the cache: files that can be made again."""

import contextlib
import os
from pathlib import Path


def cache_folder() -> Path | None:
    """$QNERF_CACHE, else $XDG_CACHE_HOME/qnerf, else ~/.cache/qnerf; None without a home folder."""
    own, base = os.environ.get("QNERF_CACHE"), os.environ.get("XDG_CACHE_HOME")
    with contextlib.suppress(RuntimeError):  # no home folder
        return Path(own).expanduser() if own else Path(base or "~/.cache").expanduser() / "qnerf"
    return None
