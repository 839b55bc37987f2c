"""`ErrorMap`: training pixels where the last renderings were wrong, for batches that have more of them."""

import torch
from torch import Tensor

FEWEST, CELLS = 64, 2**17  # pixels of a cell at least; cells at most
FIRST = 0.1  # squared error of a cell that no batch has touched yet: larger than what is left after some steps
FLOOR = 1e-5  # so that every cell keeps being drawn


class ErrorMap:
    """The squared error of colours in each cell of training pixels, as far as batches of rays have shown it.

    A cell holds consecutive pixels. Everything stays on the device, and nothing waits for it.

    Args:
        pixels: number of training pixels.
        stride: every `stride`-th pixel is held out for validation; 0: none.
        device: of all tensors.
        dtype: of the errors.
    """

    def __init__(self, pixels: int, stride: int, device: torch.device, dtype: torch.dtype) -> None:
        self.pixels, self.stride = pixels, stride
        self.size = max(FEWEST, -(-pixels // CELLS))
        self.cells = torch.full((-(-pixels // self.size),), FIRST, device=device, dtype=dtype)

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Numbers (count,) of training pixels, int64: a cell in proportion to its error, then any of its pixels.

        `generator` is on the device.
        """
        cells = torch.multinomial(self.cells, count, replacement=True, generator=generator)
        within = torch.randint(self.size, (count,), generator=generator, device=self.cells.device)
        numbers = (cells * self.size + within).clamp(max=self.pixels - 1)
        if self.stride:
            numbers -= ((numbers + 1) % self.stride == 0).long()
        return numbers

    @torch.no_grad()
    def add(self, numbers: Tensor, colors: Tensor, target: Tensor) -> None:
        """Notes what was rendered at the pixels `numbers` (R,): colours (R, 3), and the true ones (R, 3).

        A cell's error becomes the mean of its last value and the new ones.
        """
        errors = (colors - target).square().mean(1).clamp(min=FLOOR).to(self.cells)
        self.cells.scatter_reduce_(0, numbers // self.size, errors, "mean")
