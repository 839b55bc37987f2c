"""LPIPS, the learned perceptual distance (arXiv:1801.03924) with AlexNet, if its weights are installed.

The package `lpips` needs torchvision, which is not a dependency, so its network is written out here. Two files are
needed, and nothing is ever downloaded:
- alexnet-owt-7be5be79.pth, torchvision's AlexNet, from the folder QNERF_LPIPS_WEIGHTS or from torch hub's cache;
- alex.pth, the linear heads (version 0.1), from that folder or from the package `lpips` if it is installed.
"""

import importlib.util
import os
from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor, nn

BACKBONE = "alexnet-owt-7be5be79.pth"
HEADS = "alex.pth"
VARIABLE = "QNERF_LPIPS_WEIGHTS"

_CHANNELS = (64, 192, 384, 256, 256)
_MIN_SIDE = 31  # pixels; the last layers of smaller images are empty


class LPIPS(nn.Module):
    """Images (N, 3, H, W) in [0, 1], sides of at least 31 pixels -> distance (N,) >= 0; 0 for identical images.

    Features after each of AlexNet's five ReLUs are normalised to unit length at every pixel; their squared differences
    are weighted by the heads, summed over channels and averaged over pixels, then summed over the five layers.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Sequential(
            nn.Conv2d(3, 64, kernel_size=11, stride=4, padding=2),
            nn.ReLU(),
            nn.MaxPool2d(kernel_size=3, stride=2),
            nn.Conv2d(64, 192, kernel_size=5, padding=2),
            nn.ReLU(),
            nn.MaxPool2d(kernel_size=3, stride=2),
            nn.Conv2d(192, 384, kernel_size=3, padding=1),
            nn.ReLU(),
            nn.Conv2d(384, 256, kernel_size=3, padding=1),
            nn.ReLU(),
            nn.Conv2d(256, 256, kernel_size=3, padding=1),
            nn.ReLU(),
        )
        self.heads = nn.ParameterList(torch.ones(channels) for channels in _CHANNELS)
        self.register_buffer("shift", torch.tensor([-0.030, -0.088, -0.188])[:, None, None])
        self.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450])[:, None, None])

    def load(self, backbone: Path, heads: Path) -> "LPIPS":
        """Reads the two files; ValueError if one has other contents."""
        try:
            state = torch.load(backbone, map_location="cpu", weights_only=True)
            prefix = "features."
            self.features.load_state_dict(
                {key.removeprefix(prefix): value for key, value in state.items() if key.startswith(prefix)}
            )
        except Exception as error:
            raise ValueError(f"{backbone}: not AlexNet's weights as torchvision saves them") from error
        try:
            state = torch.load(heads, map_location="cpu", weights_only=True)
            weights = [state[f"lin{layer}.model.1.weight"].view(-1) for layer in range(len(_CHANNELS))]
            self.heads.load_state_dict({str(layer): weight for layer, weight in enumerate(weights)})
        except Exception as error:
            raise ValueError(f"{heads}: not the linear heads of LPIPS 0.1 for AlexNet") from error
        return self

    def layers(self, images: Tensor) -> list[Tensor]:
        """Normalised features of the five layers."""
        x = (images * 2 - 1 - self.shift) / self.scale
        features = []
        for layer in self.features:
            x = layer(x)
            if isinstance(layer, nn.ReLU):
                features.append(x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10))
        return features

    def forward(self, images: Tensor, truth: Tensor) -> Tensor:
        pairs = zip(self.layers(images), self.layers(truth), self.heads, strict=True)
        distances = [((a - b).square() * head[:, None, None]).sum(1).mean((1, 2)) for a, b, head in pairs]
        return torch.stack(distances).sum(0)


def _find(name: str, *folders: Path | None) -> Path | None:
    return next((folder / name for folder in folders if folder is not None and (folder / name).is_file()), None)


@lru_cache(maxsize=4)
def load(folder: str | None) -> tuple[LPIPS | None, str | None]:
    """The network, or None and the reason.

    Args:
        folder: searched first; None: only the caches.

    Raises:
        ValueError: `folder` does not exist, or a file is not what its name says.
    """
    own = Path(folder) if folder else None
    if own is not None and not own.is_dir():
        raise ValueError(f"{VARIABLE}: a folder with {BACKBONE} and {HEADS} expected, {folder!r} is none")
    spec = importlib.util.find_spec("lpips")
    package = Path(spec.origin).parent / "weights" / "v0.1" if spec and spec.origin else None
    backbone = _find(BACKBONE, own, Path(torch.hub.get_dir()) / "checkpoints")
    heads = _find(HEADS, own, package)
    missing = [name for name, path in ((BACKBONE, backbone), (HEADS, heads)) if path is None]
    if backbone is None or heads is None:
        return None, f"weights not found: {', '.join(missing)} (put them into a folder and set {VARIABLE})"
    return LPIPS().load(backbone, heads).eval().requires_grad_(False), None


def weights(folder: str | None = None) -> tuple[LPIPS | None, str | None]:
    """`load` of the folder, by default of the environment variable QNERF_LPIPS_WEIGHTS."""
    return load(folder or os.environ.get(VARIABLE))


@torch.no_grad()
def lpips(image: Tensor, truth: Tensor, folder: str | None = None) -> tuple[float | None, str | None]:
    """LPIPS distance of two images (H, W, 3) in [0, 1], or None and the reason.

    Args:
        image, truth: of one size.
        folder: with the weights; None: the environment variable QNERF_LPIPS_WEIGHTS, then the caches.
    """
    network, reason = weights(folder)
    if network is None:
        return None, reason
    if min(image.shape[:2]) < _MIN_SIDE:
        return None, f"images of {image.shape[0]} x {image.shape[1]} pixels are too small, {_MIN_SIDE} are needed"
    pair = torch.stack([image, truth]).detach().float().cpu().permute(0, 3, 1, 2)
    return float(network(pair[:1], pair[1:])), None
