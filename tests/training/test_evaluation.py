import numpy as np
import pytest
import torch

from qnerf.training.evaluation import Evaluator, RenderedView, shade
from tests.helpers.trainer import built


@pytest.fixture
def make(tiny):
    _, scene, model, table, watch = built(tiny("field=qcolor", "qiren.qubits=3"))

    def evaluator(chunk=2048, background="white"):
        return Evaluator(scene, table, model, background=background, chunk=chunk, watch=watch)

    return evaluator


def test_the_picture_does_not_depend_on_the_chunk_and_leaves_the_model_as_it_was(make):
    state = torch.get_rng_state()
    view = make().scene.eval[0]
    make().model.train()
    whole, pieces = (make(chunk).render(view, step=0) for chunk in (2048, 7))
    torch.testing.assert_close(whole.color, pieces.color)
    torch.testing.assert_close(whole.depth, pieces.depth)
    assert whole.color.shape == (6, 8, 3)
    assert make().model.training
    assert torch.equal(torch.get_rng_state(), state)


def test_measures_are_those_of_the_rendered_view(make):
    evaluator = make()
    view = evaluator.scene.eval[0]
    ((rendered, row),) = evaluator.views([view], step=0)
    truth = evaluator.scene.images[view].double() / 255
    error = (rendered.color.double() - truth).square().mean().item()
    assert row["psnr"] == pytest.approx(-10 * np.log10(error), abs=1e-5)
    assert row["image"] == evaluator.scene.names[view]
    assert row["lpips"] is None
    assert row["lpips_reason"]
    assert row["depth_error"] is None


def test_some_rays_of_a_view_measure_what_the_whole_has_there(make):
    evaluator = make()
    ((rendered, row),) = evaluator.views([view := evaluator.scene.eval[0]], step=0, rays=12)
    ((whole, _),) = evaluator.views([view], step=0)
    assert rendered.color.shape == (3, 4, 3)  # of 6 x 8
    assert torch.equal(rendered.color, whole.color[::2, ::2])
    error = (rendered.color.double() - evaluator.scene.images[view][::2, ::2].double() / 255).square().mean().item()
    assert row["psnr"] == pytest.approx(-10 * np.log10(error), abs=1e-5)
    assert row["ssim"] is row["lpips"] is None


def test_a_picture_has_four_panels_enlarged(make):
    evaluator = make()
    rendered = evaluator.render(evaluator.scene.eval[0], step=0)
    picture = evaluator.picture(rendered)
    assert picture.dtype == np.uint8
    assert picture.shape == (240, 4 * 8 * 40, 3)
    truth = evaluator.scene.images[rendered.view].numpy()
    np.testing.assert_array_equal(picture[::40, : 8 * 40 : 40], truth)


def test_a_picture_of_one_row_stays_in_memory(make):
    """Enlarged to 240 rows, a row of 2,000 pixels would have 460 million pixels in its four panels."""
    evaluator = make()
    row = RenderedView(0, torch.zeros(1, 2000, 3), torch.ones(1, 2000), torch.ones(1, 2000))
    evaluator.truth = lambda _: torch.zeros(1, 2000, 3)
    assert evaluator.picture(row).shape == (1, 8000, 3)


def test_a_large_view_is_shaded_by_some_of_its_pixels(monkeypatch):
    """`torch.quantile` takes 2^24 values at most."""
    depth = torch.rand(64, 65, generator=torch.Generator().manual_seed(0)) + 1
    whole = shade(depth)
    monkeypatch.setattr("qnerf.training.evaluation.MAX_PIXELS", 1000)
    torch.testing.assert_close(shade(depth), whole, rtol=0, atol=0.02)


def test_near_depth_is_brighter_than_far():
    shaded = shade(torch.tensor([[1.0, 2.0, 1000.0]])).sum(-1)
    assert shaded[0, 0] > shaded[0, 1] > shaded[0, 2]
    assert torch.isfinite(shade(torch.full((3, 3), 2.0))).all()


@pytest.mark.parametrize("activation", ["linear", "scaled", "sigmoid"])
def test_colours_are_clamped_in_evaluation_alone(tiny, activation):
    _, scene, model, table, watch = built(tiny("field=qcolor", "qiren.qubits=3", f"color.activation={activation}"))
    with torch.no_grad():
        model.field.color_head.readout.bias.fill_(2.0)
    evaluator = Evaluator(scene, table, model, background="white", chunk=2048, watch=watch)
    assert float(evaluator.render(scene.eval[0], step=0).color.max()) <= 1
    rendering, _, _ = model(table.view(scene.eval[0]), background="last_sample", step=0, watch=watch)
    outside = bool((rendering.color > 1).any())
    assert outside == (activation == "linear"), "training compares a linear colour as it is"
    rendering.color.sum().backward()
    assert float(model.field.color_head.readout.bias.grad.abs().sum()) > 0
