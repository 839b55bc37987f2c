"""Memory that is used again: kernels/buffer_pool.py."""

import gc

import numpy as np
import pytest
import torch

from qnerf.encoders import HashEncoder
from qnerf.kernels import plain
from qnerf.kernels.buffer_pool import LARGE, pooled_empty

SHAPE = (3, LARGE // 4, 1)
SINGLE = np.dtype(np.float32)


def test_memory_that_nothing_holds_is_handed_out_again():
    first = pooled_empty(SHAPE, SINGLE)
    address = first.data_ptr()
    assert first.shape == SHAPE
    assert first.dtype == torch.float32
    del first
    gc.collect()
    assert pooled_empty(SHAPE, SINGLE).data_ptr() == address


@pytest.mark.parametrize("hold", [lambda t: t, lambda t: t.view(-1)[:5], lambda t: t.numpy(), lambda t: t.detach()])
def test_memory_that_anything_holds_is_not(hold):
    held = hold(pooled_empty(SHAPE, SINGLE).fill_(7))
    gc.collect()
    pooled_empty(SHAPE, SINGLE).fill_(-1)
    pooled_empty(SHAPE, SINGLE).fill_(-2)
    assert bool((held == 7).all())


def test_sizes_and_dtypes_do_not_share():
    one, other = pooled_empty(SHAPE, SINGLE).fill_(1), pooled_empty(SHAPE, np.dtype(np.float64)).fill_(2)
    small = pooled_empty((2, 3), SINGLE).fill_(3)
    assert one.unique().tolist() == [1]
    assert other.unique().tolist() == [2]
    assert small.unique().tolist() == [3]


def test_gradients_of_large_tables_are_those_of_the_reference_step_after_step():
    """Each step's gradient reuses the memory of the last: held gradients must not change, new ones hold nothing old."""
    encoder = HashEncoder(3, log2_table_size=17, levels=2, features=2)
    held = []
    for step in range(4):
        points = torch.rand(50, 3, generator=torch.Generator().manual_seed(step))
        encoder.table.grad = None
        encoder(points).square().sum().backward()
        gradient = encoder.table.grad
        if step % 2:
            held.append((gradient, gradient.clone()))
        with plain():
            expected = torch.autograd.grad(encoder(points).square().sum(), encoder.table)[0]
        torch.testing.assert_close(gradient, expected, rtol=1e-5, atol=1e-9)
    assert all(torch.equal(now, then) for now, then in held)
