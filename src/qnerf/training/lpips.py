"""LPIPS, the learned perceptual distance (arXiv:1801.03924) with AlexNet, if its weights are at hand.

The package `lpips` needs torchvision, which is not a dependency. Two files in the folder QNERF_LPIPS_WEIGHTS are
needed, and nothing is ever downloaded: torchvision's AlexNet, and the linear heads of LPIPS 0.1.
"""

import os
from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d, normalize

BACKBONE = "alexnet-owt-7be5be79.pth"
HEADS = "alex.pth"
VARIABLE = "QNERF_LPIPS_WEIGHTS"

LAYERS = ((0, 4, 2), (3, 1, 2), (6, 1, 1), (8, 1, 1), (10, 1, 1))
"""AlexNet's convolutions: number among its layers, stride, padding. The second and the third follow a pooling."""
SHAPES = ((64, 3, 11, 11), (192, 64, 5, 5), (384, 192, 3, 3), (256, 384, 3, 3), (256, 256, 3, 3))
SHIFT, SCALE = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
MIN_SIDE = 31  # pixels; the last layers of smaller images are empty

Weights = list[tuple[Tensor, Tensor, Tensor]]
"""Of each convolution: its weight and bias, and the head's weights of its channels."""


@lru_cache(maxsize=1)
def load(folder: str) -> Weights:
    """The weights in a folder; ValueError if a file is missing or is something else."""
    backbone, heads = (_read(Path(folder) / name) for name in (BACKBONE, HEADS))
    weights = []
    for layer, ((number, _, _), shape) in enumerate(zip(LAYERS, SHAPES, strict=True)):
        keys = f"features.{number}.weight", f"features.{number}.bias"
        weight, bias = (backbone.get(key, torch.empty(0)) for key in keys)
        head = heads.get(f"lin{layer}.model.1.weight", torch.empty(0)).flatten()
        if weight.shape != shape or len(bias) != shape[0]:
            raise ValueError(f"{folder}/{BACKBONE}: expected AlexNet's weights as torchvision saves them")
        if len(head) != shape[0]:
            raise ValueError(f"{folder}/{HEADS}: expected the linear heads of LPIPS 0.1 for AlexNet")
        weights.append((weight, bias, head))
    return weights


def _read(file: Path) -> dict[str, Tensor]:
    try:
        return dict(torch.load(file, map_location="cpu", weights_only=True))
    except Exception as error:
        raise ValueError(f"{VARIABLE}: {file} cannot be read as weights: {type(error).__name__}") from error


def weights() -> Weights | None:
    """Those of the folder QNERF_LPIPS_WEIGHTS; None if it is not set. ValueError as `load`."""
    folder = os.environ.get(VARIABLE)
    return load(folder) if folder else None


@torch.no_grad()
def lpips(image: Tensor, truth: Tensor) -> tuple[float | None, str | None]:
    """LPIPS distance of two images (H, W, 3) in [0, 1], at least 0, or None and the reason.

    Features after each of AlexNet's five ReLUs are normalised to unit length at every pixel. Their squared differences
    are weighted by the heads, summed over channels, averaged over pixels, and summed over the five layers.
    """
    layers = weights()
    if layers is None:
        return None, f"put {BACKBONE} and {HEADS} into a folder and set {VARIABLE}"
    if min(image.shape[:2]) < MIN_SIDE:
        return None, f"images of {image.shape[0]} x {image.shape[1]} pixels are too small, {MIN_SIDE} are needed"
    pair = torch.stack([image, truth]).float().cpu()
    x = ((pair * 2 - 1 - SHIFT) / SCALE).permute(0, 3, 1, 2)
    total = 0.0
    for (number, stride, padding), (weight, bias, head) in zip(LAYERS, layers, strict=True):
        if number in (3, 6):
            x = max_pool2d(x, 3, 2)
        x = conv2d(x, weight, bias, stride, padding).relu()
        one, other = normalize(x, eps=1e-10)
        total += float(((one - other).square() * head[:, None, None]).sum(0).mean())
    return total, None
