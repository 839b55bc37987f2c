import pytest
import torch

from qnerf.training.error_map import CELLS, ErrorMap
from tests.helpers.trainer import trainer

CPU = torch.device("cpu")


def test_cells_are_drawn_in_proportion_to_their_errors():
    errors = ErrorMap(10 * 64, 0, CPU, torch.float64)
    numbers = torch.arange(640).repeat_interleave(2)  # 128 renderings of each cell
    wrong = torch.where(numbers // 64 == 3, 0.4, 0.1).double()
    for _ in range(3):
        errors.add(numbers, wrong[:, None].sqrt().expand(-1, 3), torch.zeros(1280, 3, dtype=torch.float64))
    drawn = errors.draw(100_000, torch.Generator().manual_seed(0))
    counted = torch.bincount(drawn // 64, minlength=10) / 100_000
    expected = torch.full((10,), 0.1 / 1.3).index_fill_(0, torch.tensor([3]), 0.4 / 1.3)
    torch.testing.assert_close(counted, expected, rtol=0, atol=5e-3)
    assert len(drawn.unique()) == 640


@pytest.mark.parametrize("stride", [0, 2, 7])
@pytest.mark.parametrize("pixels", [5, 65, 1000])
def test_only_pixels_that_train_are_drawn(pixels, stride):
    drawn = ErrorMap(pixels, stride, CPU, torch.float32).draw(5000, torch.Generator().manual_seed(0))
    assert 0 <= drawn.min() <= drawn.max() < pixels
    assert not stride or ((drawn + 1) % stride != 0).all()


def test_large_photographs_have_larger_cells():
    assert len(ErrorMap(10**8, 0, CPU, torch.float32).cells) <= CELLS


def test_a_pixel_that_stays_wrong_takes_its_share_of_the_batch(tiny, monkeypatch):
    taken = trainer(tiny("field=classical", "train.rays=400", "train.error_rays=0.5"))
    taken.error_map.cells.fill_(1e-9)[1] = 1.0
    rendered = []
    monkeypatch.setattr(taken.error_map, "add", lambda *seen: rendered.append(seen))
    taken.take_step(measure=False)
    (numbers, colors, target), *_ = rendered
    assert (numbers[200:] // taken.error_map.size == 1).all()
    assert len((numbers[:200] // taken.error_map.size).unique()) > 1
    assert len(numbers) == len(colors) == len(target)
