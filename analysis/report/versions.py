"""Which version of qnerf wrote each run."""

import json
from collections.abc import Iterable
from pathlib import Path


def versions(paths: Iterable[str]) -> list[str | None]:
    """From environment.json in each run's folder; None where it does not say."""
    return [_version(Path(path) / "environment.json") for path in paths]


def _version(path: Path) -> str | None:
    try:
        return str(json.loads(path.read_bytes())["packages"]["qnerf"])
    except (OSError, ValueError, KeyError, TypeError):  # absent, damaged, or of another form
        return None
