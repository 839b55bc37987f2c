import pytest

from tests.helpers.sweep import mixed, sweep


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """The store of `tests.helpers.sweep`: two fields, two seeds, on one scene, and two runs that did not finish."""
    return sweep(tmp_path_factory.getbasetemp())


@pytest.fixture(scope="session")
def mixed_store(tmp_path_factory):
    """`trained`, with photographs, distances and tracked loops in the same store."""
    return mixed(tmp_path_factory.getbasetemp())
