"""How a model starts: neither transparent nor, where it is told so, dense."""

import pytest
import torch

from qnerf.config.folders import CONF
from qnerf.geometry.visibility import REACH
from tests.helpers.configs import composed
from tests.helpers.trainer import built
from tests.helpers.worlds import ball, write


@pytest.mark.parametrize(
    "thin",
    [
        "visibility.alpha=true",
        "visibility.alpha=true visibility.cameras=0 contraction=linf",
        "render.near=0.9 render.far=1.1",
        "needs=auto visibility.alpha=true",
    ],
)
@pytest.mark.parametrize("field", sorted(path.stem for path in (CONF / "field").glob("*.yaml")))
def test_most_rays_start_half_opaque_in_a_thin_space(tmp_path, field, thin):
    """Transparent over white, dark pixels are learnt as black fog before any colour moves."""
    folder = write(ball(views=6, size=24, focal=22, radius=0.1), tmp_path / "ball")
    scene = ("scene=nerfstudio", f"scene.path={folder}", "render.background=white", "hash=C7")
    _, _, model, table, _ = built(composed(f"field={field}", *scene, *thin.split()))
    rays, _ = table.batch(table.draw(400, torch.Generator().manual_seed(0)))
    edges = torch.linspace(table.near, min(table.far, table.near + REACH), 600)
    points = rays.origins[:, None] + rays.directions[:, None] * edges[None, :, None]
    with torch.no_grad():
        depth = model.field.density(points).sum(1) * (edges[1] - edges[0])
    opacity = -torch.expm1(-depth[depth > 0])
    assert 0.45 < opacity.quantile(0.25) < 0.75


def test_a_space_that_is_not_thin_starts_with_the_density_that_was_asked_for(tiny):
    _, _, model, _, _ = built(tiny("density.initial=0.3"))
    assert model.field.initial == 0.3
