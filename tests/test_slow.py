"""The list of slow tests names tests that exist."""

from tests.conftest import SLOW
from tests.helpers.configs import ROOT


def test_every_slow_test_is_there():
    for entry in SLOW:
        file, _, test = entry.partition("::")
        path = ROOT / "tests" / file
        assert path.exists(), entry
        assert not test or f"def {test}" in path.read_text(), entry
