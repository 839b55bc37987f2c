from pathlib import Path

import pytest

from qnerf.records import RunStore, index


@pytest.fixture
def store_(tmp_path: Path) -> RunStore:
    return RunStore(tmp_path / "runs", every=60)


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The runs that the index reads from now on."""
    seen: list[str] = []
    row = index._row

    def recording(folder: Path) -> object:
        seen.append(folder.name)
        return row(folder)

    monkeypatch.setattr(index, "_row", recording)
    return seen
