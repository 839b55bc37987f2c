"""Counting the cameras that see points."""

import hypothesis.extra.numpy as arrays
import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from qnerf.kernels import plain
from qnerf.kernels.projection import count_views, count_views_reference

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


def test_borders_belong_to_the_image_and_what_lies_behind_does_not():
    camera = torch.tensor([[[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]]).double()  # pixel = (x, y) / z
    points = torch.tensor([[0, 0, 1], [4, 6, 2], [-1, 0, 1], [3, 1, 1], [1, 4, 1], [-1, -1, -1], [0, 0, 0]]).double()
    expected = [1, 1, 0, 0, 0, 0, 0]  # in an image of 2 x 3
    for count in (count_views, count_views_reference):
        assert count(points, camera, 2, 3, 1).tolist() == expected
