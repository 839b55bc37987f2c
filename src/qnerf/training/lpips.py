"""LPIPS, the learned perceptual distance (arXiv:1801.03924) with AlexNet, if its weights are at hand.

The package `lpips` needs torchvision, which is not a dependency. Two files in the folder QNERF_LPIPS_WEIGHTS are
needed, and nothing is ever downloaded: torchvision's AlexNet, and the linear heads of LPIPS 0.1.
"""

import os
from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

BACKBONE = "alexnet-owt-7be5be79.pth"
HEADS = "alex.pth"
VARIABLE = "QNERF_LPIPS_WEIGHTS"
SHIFT, SCALE = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
MIN_SIDE = 31  # pixels; the last layers of smaller images are empty


def alexnet() -> nn.Sequential:
    """AlexNet's layers, up to its last ReLU, under torchvision's names."""
    conv, relu, pool = nn.Conv2d, nn.ReLU(), nn.MaxPool2d(3, 2)
    first = [conv(3, 64, 11, 4, 2), relu, pool, conv(64, 192, 5, padding=2), relu, pool]
    widths = ((192, 384), (384, 256), (256, 256))
    return nn.Sequential(*first, *(layer for width in widths for layer in (conv(*width, 3, padding=1), relu)))


@lru_cache(maxsize=1)
def load(folder: str) -> tuple[nn.Sequential, list[Tensor]]:
    """The network, and of each of its ReLUs the head's weights (C, 1, 1). ValueError if the files hold none."""
    try:
        backbone, heads = (torch.load(Path(folder) / name, "cpu", weights_only=True) for name in (BACKBONE, HEADS))
        with torch.device("meta"):
            network = alexnet()
        own = {name.removeprefix("features."): one for name, one in backbone.items() if name.startswith("features.")}
        network.load_state_dict(own, assign=True)
        return network, [heads[f"lin{number}.model.1.weight"].view(-1, 1, 1) for number in range(5)]
    except Exception as error:
        told = f"expected torchvision's {BACKBONE} and the {HEADS} of LPIPS 0.1, got {type(error).__name__}"
        raise ValueError(f"{VARIABLE}={folder}: {told}") from error


def weights() -> tuple[nn.Sequential, list[Tensor]] | None:
    """The weights in the folder QNERF_LPIPS_WEIGHTS; None if it is not set. ValueError as `load`."""
    folder = os.environ.get(VARIABLE)
    return load(folder) if folder else None


@torch.no_grad()
def lpips(image: Tensor, truth: Tensor) -> tuple[float | None, str | None]:
    """LPIPS distance of two images (H, W, 3) in [0, 1], at least 0, or None and the reason.

    Features after each of AlexNet's five ReLUs are normalised to unit length at every pixel. Their squared differences
    are weighted by the heads, summed over channels, averaged over pixels, and summed over the five layers.
    """
    loaded = weights()
    if loaded is None:
        return None, f"put {BACKBONE} and {HEADS} into a folder and set {VARIABLE}"
    if min(image.shape[:2]) < MIN_SIDE:
        return None, f"images of {image.shape[0]} x {image.shape[1]} pixels are too small, {MIN_SIDE} are needed"
    network, heads = loaded
    pair = torch.stack([image, truth]).float().cpu()
    x = ((pair * 2 - 1 - SHIFT) / SCALE).permute(0, 3, 1, 2)
    total, left = 0.0, iter(heads)
    for layer in network:
        x = layer(x)
        if isinstance(layer, nn.ReLU):
            one, other = normalize(x, eps=1e-10)
            total += float(((one - other).square() * next(left)).sum(0).mean())
    return total, None
