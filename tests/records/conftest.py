from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from qnerf.records import RunStore
from qnerf.records.index import locations


@pytest.fixture
def store_(tmp_path: Path) -> RunStore:
    return RunStore(tmp_path / "runs", every=60, watch=0.3)


@pytest.fixture(autouse=True)
def _cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("QNERF_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def settled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files count as settled as soon as they are written."""
    monkeypatch.setattr(locations, "SETTLED", -3600.0)


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """(file, run) of everything that the index reads from now on."""
    seen: list[tuple[str, str]] = []
    read = locations.FolderLocation.read

    def recording(location: locations.FolderLocation, file: str, runs: list[str]) -> Iterator[Any]:
        seen.extend((file, run) for run in runs)
        return read(location, file, runs)

    monkeypatch.setattr(locations.FolderLocation, "read", recording)
    return seen
