"""What flows through the pipeline. Read this page first: it is the legend of every shape, unit and convention.

    scene -> rays -> samples -> field (encoder, density head, colour head) -> render -> loss

A pixel becomes a ray. A sampler cuts the ray into intervals. The field gives each interval's midpoint a density and a
colour. Volume rendering composites them into the pixel's colour.

Shape letters, the same everywhere:

    V views      H, W image height and width in pixels
    R rays       K samples on a ray (K + 1 edges)      N points: any number of leading dimensions flattened
    F features of an encoding      G geometry features (density head -> colour head)      A appearance features
    L levels of a hash grid        T entries of one level's table
    n wires      S spectral layers (data re-uploadings)      B batch of circuit inputs

Units and conventions:

- World units are those of the normalised scene: +z up, cameras centred, their largest absolute coordinate 1.
- Depth is the distance along the ray's unit direction, in world units. Density is per world unit.
- Colours are in [0, 1] and sRGB-encoded, as in the images. Angles are radians.
- Camera axes are OpenGL's: +x right, +y up, the camera looks along -z. Poses are camera-to-world.
- The weight w_i of interval i is T_i (1 - e^(-sigma_i delta_i)): sigma is the density, delta the interval's length and
  T_i the transmittance, the share of light that reaches the interval (`qnerf.rendering.render`).
"""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Rays:
    """R rays, each bounded by `near` and `far`.

    >>> import torch
    >>> bounds = torch.tensor([[0.0]]), torch.tensor([[10.0]])
    >>> ray = Rays(torch.tensor([[1.0, 0, 0]]), torch.tensor([[0.0, 0, 1]]), torch.tensor([0]), *bounds)
    >>> ray.along(torch.tensor([[2.0, 3.0]])).tolist()
    [[[1.0, 0.0, 2.0], [1.0, 0.0, 3.0]]]
    """

    origins: Tensor  # (R, 3) world units
    directions: Tensor  # (R, 3) unit length
    cameras: Tensor  # (R,) int64: the view that each ray belongs to
    near: Tensor  # (R, 1) distance along the direction, world units
    far: Tensor  # (R, 1)

    def __len__(self) -> int:
        return self.origins.shape[0]

    def __getitem__(self, index: slice | Tensor) -> "Rays":
        return Rays(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def detach(self) -> "Rays":
        """The same rays, without gradients and tangents."""
        return Rays(*(getattr(self, name).detach() for name in self.__dataclass_fields__))

    def along(self, distance: Tensor) -> Tensor:
        """World points (R, K, 3) at `distance` (R, K) along each ray."""
        return self.origins[:, None, :] + self.directions[:, None, :] * distance[..., None]


@dataclass(frozen=True)
class Samples:
    """K adjacent intervals on each ray: interval k lies between edges k and k + 1.

    >>> import torch
    >>> samples = Samples(torch.tensor([[0.0, 1.0, 4.0]]), torch.tensor([[0.0, 0.25, 1.0]]))
    >>> samples.mids.tolist(), samples.deltas.tolist()
    ([[0.5, 2.5]], [[1.0, 3.0]])
    """

    edges: Tensor  # (R, K + 1) distance along the ray, world units, non-decreasing
    spacing: Tensor  # (R, K + 1) the same edges in the sampler's normalised coordinate s in [0, 1]

    @property
    def mids(self) -> Tensor:
        """(R, K) distances of the interval midpoints."""
        return 0.5 * (self.edges[..., 1:] + self.edges[..., :-1])

    @property
    def deltas(self) -> Tensor:
        """(R, K) interval lengths."""
        return self.edges[..., 1:] - self.edges[..., :-1]


@dataclass(frozen=True)
class Rendering:
    """The result of volume rendering for R rays. Depths lie between the first and the last midpoint."""

    color: Tensor  # (R, 3)
    accumulation: Tensor  # (R,) sum of the weights: opacity, in [0, 1]
    weights: Tensor  # (R, K)
    samples: Samples

    @property
    def depth(self) -> Tensor:
        """(R,) expected distance sum w t / sum w over interval midpoints t, world units."""
        mids = self.samples.mids
        depth = (self.weights * mids).sum(-1) / (self.weights.sum(-1) + 1e-10)
        return torch.minimum(torch.maximum(depth, mids[:, 0]), mids[:, -1])

    @property
    def depth_median(self) -> Tensor:
        """(R,) distance at which the transmittance falls below 1/2, world units."""
        mids = self.samples.mids
        half = (self.weights.detach().cumsum(-1) < 0.5).sum(-1, keepdim=True).clamp_(max=mids.shape[1] - 1)
        return mids.detach().gather(-1, half)[:, 0]
