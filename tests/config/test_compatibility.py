import json
from pathlib import Path

import pytest

from qnerf.config.identity import identity
from qnerf.model.labels import slug
from tests.helpers.configs import composed

GOLDEN = json.loads((Path(__file__).parent / "golden_ids.json").read_text())


@pytest.mark.parametrize("run", GOLDEN["runs"], ids=lambda run: run["overrides"])
def test_every_run_keeps_its_id(run):
    """As it was before options got new names, from the command as it was typed then."""
    config = composed(*run["overrides"].split())
    assert (slug(config), identity(config), identity(config, "abc")) == (run["slug"], run["id"], run["of scene abc"])
