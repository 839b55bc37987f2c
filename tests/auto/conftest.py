import pytest

from qnerf.scenes import SCENES


@pytest.fixture(scope="session")
def poster():
    """The built-in scene with 24 views."""
    return SCENES.build("poster", views=24)
