"""The features of the encoders on a plane through the scene."""

from collections.abc import Iterator

import pandas as pd
import torch
from torch import Tensor, nn

from qnerf.encoders import DIRECTIONS, ENCODERS
from qnerf.probes.trained import Trained

RESOLUTION = 160  # pixels along each side: two for each period of the eighth positional band, 75 cycles
CHANNELS = 8


def table(trained: Trained) -> pd.DataFrame:
    """One row for each pixel of each encoder's slice.

    The slice is the plane z = 0 of the world in contracted space, z = 1/2 of the unit cube. Spherical harmonics encode
    directions instead of points: their pixels cover the sphere.

    Columns: encoder; trained: true for this run's own encoder, false for the others as built; row, column; x, y: the
    pixel's centre in the unit cube (on the sphere: longitude / 2 pi, and (1 + cos of the angle from +z) / 2);
    channel_0 .. channel_7, NaN where the encoder has fewer.
    """
    unit = _grid()
    dtype, device = trained.settings.dtype, trained.settings.torch_device
    points = torch.cat([unit, torch.full_like(unit[:, :1], 0.5)], dim=1)
    parts = [_rows(trained.settings.encoder["name"], True, unit, trained.model.field.encoder, points.to(device, dtype))]
    for name, encoder in _others(trained.settings.encoder["name"]):
        parts.append(_rows(name, False, unit, encoder, points.float()))
    parts.append(_rows("sh", False, unit, DIRECTIONS.build("sh"), _sphere(unit).float()))
    return pd.concat(parts, ignore_index=True)


def _others(own: str) -> Iterator[tuple[str, nn.Module]]:
    """The other encoders of points, with their default options."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        for name in ("pe", "rff", "hash"):
            if name != own:
                yield name, ENCODERS.build(name, 3)


def _grid() -> Tensor:
    """Pixel centres (N, 2) of the unit square, row by row from the lowest y."""
    centres = (torch.arange(RESOLUTION, dtype=torch.float64) + 0.5) / RESOLUTION
    y, x = torch.meshgrid(centres, centres, indexing="ij")
    return torch.stack([x, y], dim=-1).reshape(-1, 2)


def _sphere(unit: Tensor) -> Tensor:
    """Unit square (N, 2) -> unit directions (N, 3); areas keep their proportions."""
    longitude, z = 2 * torch.pi * unit[:, 0], 2 * unit[:, 1] - 1
    radius = (1 - z.square()).sqrt()
    return torch.stack([radius * longitude.cos(), radius * longitude.sin(), z], dim=-1)


@torch.no_grad()
def _rows(name: str, trained: bool, unit: Tensor, encoder: nn.Module, inputs: Tensor) -> pd.DataFrame:
    features = encoder(inputs).float().cpu()[:, :CHANNELS]
    missing = torch.full((len(features), CHANNELS - features.shape[1]), torch.nan)
    channels = torch.cat([features, missing], dim=1)
    pixels = pd.DataFrame({"encoder": name, "trained": trained}, index=range(len(unit)))
    pixels["row"], pixels["column"] = pixels.index // RESOLUTION, pixels.index % RESOLUTION
    pixels[["x", "y"]] = unit.float().numpy()
    pixels[[f"channel_{index}" for index in range(CHANNELS)]] = channels.numpy()
    return pixels
