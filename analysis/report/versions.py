"""Which version of qnerf wrote each run."""

from collections.abc import Iterable
from pathlib import Path

from qnerf.records.files import read_json


def versions(paths: Iterable[str]) -> list[str | None]:
    """From environment.json in each run's folder; None where it does not say."""
    return [_version(Path(path) / "environment.json") for path in paths]


def _version(path: Path) -> str | None:
    try:
        return str(read_json(path)["packages"]["qnerf"])
    except (OSError, ValueError, KeyError, TypeError):  # absent, damaged, or of another form
        return None
