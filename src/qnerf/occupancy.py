"""Where density is, learnt while training: space found empty is sampled no more."""

import torch
from torch import Tensor

from qnerf.contraction import Contraction
from qnerf.field import Field
from qnerf.visibility import SpaceMask

DECAY = 0.7  # of the opacity that was seen, from one look at a cell to the next
CHUNK = 2**15  # cells looked at together


class Occupancy(SpaceMask):
    """A mask that closes where the field is empty (after Sec. 3.2, arXiv:2210.04847).

    Every `every` steps the density at a random point of each allowed cell is looked at. What counts is the cell's
    opacity, 1 - exp(-density x length of its shortest side): the largest seen, times 0.7 for every look since. The mask
    is open where a cell, or one of the 26 around it, has at least `least`. Closed cells are looked at like all others
    and open again when the field around them grows into them; a field that is empty everywhere closes nothing.

    Args:
        allowed: (n, n, n) bool over the unit cube: where density may be at all.
        contraction: world points <-> the unit cube.
        every: steps between looks.
        after: steps before the first look; until then every allowed cell is open.
        least: opacity, above 0 and below 1.
    """

    allowed: Tensor
    cells: Tensor
    sides: Tensor
    opacity: Tensor

    def __init__(self, allowed: Tensor, contraction: Contraction, *, every: int, after: int, least: float) -> None:
        super().__init__(allowed)
        self.every, self.after, self.least = every, after, least
        cells = allowed.flatten().nonzero()[:, 0]
        sides = shortest_sides(contraction, cells, allowed.shape[0]).to(torch.get_default_dtype())
        self.register_buffer("cells", cells, persistent=False)
        self.register_buffer("sides", sides, persistent=False)
        self.register_buffer("allowed", allowed, persistent=False)
        self.register_buffer("grid", allowed.clone())  # kept by a checkpoint; so is the opacity
        self.register_buffer("opacity", torch.zeros_like(sides))

    def due(self, step: int) -> bool:
        """Whether this step begins with a look."""
        return step >= self.after and (step - self.after) % self.every == 0

    @torch.no_grad()
    def look(self, field: Field, generator: torch.Generator) -> None:
        """Opens and closes cells by the field's density, taken in evaluation mode; `generator` places the points."""
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
        occupied[self.cells] = (self.opacity >= self.least).to(occupied.dtype)
        around = torch.nn.functional.max_pool3d(occupied.view(1, 1, n, n, n), 3, stride=1, padding=1)[0, 0] > 0
        found = around & self.allowed
        self.grid = found if bool(found.any()) else self.allowed.clone()


def shortest_sides(contraction: Contraction, cells: Tensor, n: int) -> Tensor:
    """World length of the shortest of a cell's three sides, through its centre: (N,) of cells numbered row by row."""
    centre = (torch.stack([cells // (n * n), cells // n % n, cells % n], dim=-1).to(torch.float64) + 0.5) / n
    half = 0.5 / n * torch.eye(3, dtype=torch.float64)
    ends = [contraction.inverse(centre + side) - contraction.inverse(centre - side) for side in half]
    return torch.stack([torch.linalg.vector_norm(end, dim=-1) for end in ends]).amin(0)
