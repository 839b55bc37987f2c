from collections.abc import Iterator

import pytest

from qnerf.scenes import SCENES, Scene


@pytest.fixture(scope="session")
def poster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    """The built-in scene with 24 views of 36 x 64; its cache is what runs of the same options find."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("QNERF_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield SCENES.build("poster", views=24, width=36, height=64, supersample=2)
