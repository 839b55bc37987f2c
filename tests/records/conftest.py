from pathlib import Path

import pytest

from qnerf.records import RunStore


@pytest.fixture
def store_(tmp_path: Path) -> RunStore:
    return RunStore(tmp_path / "runs", every=60, watch=0.3)
