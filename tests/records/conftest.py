import pytest

from qnerf.records import RunStore, index


@pytest.fixture
def store_(tmp_path):
    return RunStore(tmp_path / "runs", every=60)


@pytest.fixture
def reads(monkeypatch):
    """The runs that the index reads from now on."""
    seen = []
    row = index._row

    def recording(folder):
        seen.append(folder.name)
        return row(folder)

    monkeypatch.setattr(index, "_row", recording)
    return seen
