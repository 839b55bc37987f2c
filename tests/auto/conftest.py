import pytest

from qnerf.scenes import SCENES, Scene


@pytest.fixture(scope="session")
def poster() -> Scene:
    """The built-in scene with 24 views."""
    return SCENES.build("poster", views=24)
