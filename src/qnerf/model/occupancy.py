"""The occupancy grid: space that turns out to be empty during training is no longer sampled."""

import torch
from torch import Tensor

from qnerf.geometry.contraction import Contraction
from qnerf.geometry.visibility import SpaceMask, cell_centres
from qnerf.model.field import Field

DECAY = 0.7  # factor on the recorded opacity of a cell at each look
CHUNK = 2**15  # cells evaluated at once
INFINITE = 1e12  # world units beyond which a point counts as infinitely far
STEP = 1e-6  # cells: step of the finite difference


class Occupancy(SpaceMask):
    """A mask that closes where the field is empty (after Sec. 3.2, arXiv:2210.04847).

    Every `every` steps it looks at the density of a random point in each allowed cell. The opacity of a cell is
    1 - exp(-density x length of its shortest side); each cell keeps the largest one so far, times 0.7 per look since.
    The mask is open where a cell or one of its 26 neighbours has at least `min_opacity`. Closed cells are looked at,
    too, and open again when the field grows into them. If the field is empty everywhere, all allowed cells stay open.

    Args:
        allowed: (n, n, n) bool over the unit cube: where density may be at all.
        contraction: world points <-> the unit cube.
        every: steps between looks.
        after: steps before the first look; until then every allowed cell is open.
        min_opacity: above 0 and below 1.
    """

    allowed: Tensor
    cells: Tensor
    sides: Tensor
    opacity: Tensor

    def __init__(
        self, allowed: Tensor, contraction: Contraction, *, every: int, after: int, min_opacity: float
    ) -> None:
        super().__init__(allowed)
        self.every, self.after, self.min_opacity = every, after, min_opacity
        n = allowed.shape[0]
        cells = (allowed.flatten() & reachable(contraction, n)).nonzero()[:, 0]
        sides = shortest_sides(contraction, n)[cells].to(torch.get_default_dtype())
        self.register_buffer("cells", cells, persistent=False)
        self.register_buffer("sides", sides, persistent=False)
        self.register_buffer("allowed", allowed, persistent=False)
        self.register_buffer("grid", allowed.clone())  # in checkpoints, like the opacity
        self.register_buffer("opacity", torch.zeros_like(sides))

    def due(self, step: int) -> bool:
        """Whether to look before this step."""
        return step >= self.after and (step - self.after) % self.every == 0

    @torch.no_grad()
    def look(self, field: Field, generator: torch.Generator) -> None:
        """Opens and closes cells by the field's density in evaluation mode; `generator` draws the points."""
        n = self.grid.shape[0]
        corners = torch.stack([self.cells // (n * n), self.cells // n % n, self.cells % n], dim=-1)
        inside = torch.rand(corners.shape, dtype=self.sides.dtype, device=generator.device, generator=generator)
        points = (corners + inside.to(corners.device)) / n
        training = field.training
        field.eval()
        density = torch.cat([field.density_anywhere(part) for part in points.split(CHUNK)])
        field.train(training)
        opacity = -torch.expm1(-density * self.sides)
        self.opacity = torch.maximum(self.opacity * DECAY, opacity)
        occupied = torch.zeros(n**3, device=self.grid.device)
        occupied[self.cells] = (self.opacity >= self.min_opacity).to(occupied.dtype)
        around = torch.nn.functional.max_pool3d(occupied.view(1, 1, n, n, n), 3, stride=1, padding=1)[0, 0] > 0
        opened = around & self.allowed
        self.grid.copy_(torch.where(opened.any(), opened, self.allowed))


def reachable(contraction: Contraction, n: int) -> Tensor:
    """Whether a cell's centre is the image of a world point (n^3,). In the corners outside an l2 ball it is not."""
    return contraction.inverse(cell_centres(n)).abs().amax(-1) < INFINITE


def shortest_sides(contraction: Contraction, n: int) -> Tensor:
    """World length of the shortest of each cell's three sides, through its centre (n^3,), row by row.

    Measured by the derivative at the centre, because the outermost sides of a contracted cube end at infinity.
    """
    centres, steps = cell_centres(n), STEP / n * torch.eye(3, dtype=torch.float64)
    moved = [contraction.inverse(centres + step) - contraction.inverse(centres - step) for step in steps]
    return torch.stack([torch.linalg.vector_norm(each, dim=-1) for each in moved]).amin(0) / (2 * STEP)
