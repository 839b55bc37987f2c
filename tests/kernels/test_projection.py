"""Counting the cameras that see points."""

import hypothesis.extra.numpy as arrays
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from qnerf.kernels import plain
from qnerf.kernels.projection import GRAIN, count_views, count_views_reference

# Whole numbers: both forms are exact however their sums are ordered, on the borders of the images too.
whole = st.integers(-40, 40).map(float)


@given(
    points=arrays.arrays(np.float64, st.tuples(st.integers(0, 30), st.just(3)), elements=whole),
    matrices=arrays.arrays(np.float64, st.tuples(st.integers(1, 7), st.just(3), st.just(4)), elements=whole),
    width=st.integers(1, 50),
    height=st.integers(1, 50),
    max_views=st.integers(1, 8),
)
def test_the_loop_counts_what_its_reference_counts(points, matrices, width, height, max_views):
    arguments = torch.from_numpy(points), torch.from_numpy(matrices), width, height, max_views
    counted = count_views(*arguments)
    assert counted.dtype == torch.int64
    assert torch.equal(counted, count_views_reference(*arguments))
    with plain():
        assert torch.equal(counted, count_views(*arguments))


@given(seed=st.integers(0, 2**20), max_views=st.integers(1, 9))
def test_counts_stop_at_max_views(seed, max_views):
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(60, 3, dtype=torch.float64, generator=generator)
    matrices = torch.randn(8, 3, 4, dtype=torch.float64, generator=generator) * torch.tensor([5.0, 5, 1]).view(3, 1)
    every = count_views(points, matrices, 8, 8, 8)
    assert torch.equal(count_views(points, matrices, 8, 8, max_views), every.clamp(max=max_views))


def test_borders_belong_to_the_image_and_what_lies_behind_does_not():
    camera = torch.tensor([[[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]]).double()  # pixel = (x, y) / z
    points = torch.tensor([[0, 0, 1], [4, 6, 2], [-1, 0, 1], [3, 1, 1], [1, 4, 1], [-1, -1, -1], [0, 0, 0]]).double()
    expected = [1, 1, 0, 0, 0, 0, 0]  # in an image of 2 x 3
    for count in (count_views, count_views_reference):
        assert count(points, camera, 2, 3, 1).tolist() == expected


@pytest.mark.parametrize("threads", [1, 2])
def test_the_count_does_not_depend_on_the_number_of_threads(threads):
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(3 * GRAIN + 5, 3, dtype=torch.float64, generator=generator)
    matrices = torch.randn(5, 3, 4, dtype=torch.float64, generator=generator)
    expected = count_views_reference(points, matrices, 3, 2, 5)
    torch.set_num_threads(threads)
    counted = count_views(points, matrices, 3, 2, 5)
    assert expected.unique().numel() > 2
    # A point within a rounding of a border may fall on either side of it.
    assert int((counted != expected).sum()) == 0
