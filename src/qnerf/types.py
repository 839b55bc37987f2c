"""What flows through the pipeline, and the one legend of shape letters used everywhere.

    V views      H, W image height and width in pixels
    R rays       K samples on a ray (K + 1 edges)      N points: any number of leading dimensions flattened
    F features of an encoding      G geometry features (density head -> colour head)      A appearance features
    L levels of a hash grid        T entries of one level's table
    n wires      S spectral layers (data re-uploadings)      B batch of circuit inputs

World units are those of the normalised scene: oriented, centred, the largest absolute camera coordinate 1.
Depth is distance along the ray's unit direction, in world units. Colours are in [0, 1], sRGB-encoded as in the images.
"""

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Rays:
    """R rays. `directions` are unit vectors; `near`, `far` bound the distance along them."""

    origins: Tensor  # (R, 3) world units
    directions: Tensor  # (R, 3) unit length
    cameras: Tensor  # (R,) int64: index of the view each ray belongs to
    near: Tensor  # (R, 1) world units
    far: Tensor  # (R, 1) world units

    def __len__(self) -> int:
        return self.origins.shape[0]

    def __getitem__(self, index: slice | Tensor) -> "Rays":
        return Rays(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def along(self, distance: Tensor) -> Tensor:
        """Points at `distance` (R, K) along each ray: (R, K, 3)."""
        return self.origins[:, None, :] + self.directions[:, None, :] * distance[..., None]


@dataclass(frozen=True)
class Samples:
    """K intervals on each ray, contiguous: interval k lies between edges k and k + 1."""

    edges: Tensor  # (R, K + 1) distance along the ray, world units, non-decreasing
    spacing: Tensor  # (R, K + 1) the same edges in the sampler's normalised coordinate, in [0, 1]

    @property
    def mids(self) -> Tensor:
        """(R, K) distance of interval midpoints."""
        return 0.5 * (self.edges[..., 1:] + self.edges[..., :-1])

    @property
    def deltas(self) -> Tensor:
        """(R, K) interval lengths."""
        return self.edges[..., 1:] - self.edges[..., :-1]


@dataclass(frozen=True)
class Rendering:
    """What volume rendering gives for R rays."""

    color: Tensor  # (R, 3)
    depth: Tensor  # (R,) expected distance, world units
    depth_median: Tensor  # (R,) distance at which the transmittance falls below 1/2
    accumulation: Tensor  # (R,) sum of the weights, in [0, 1]
    weights: Tensor  # (R, K)
