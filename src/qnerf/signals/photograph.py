"""A photograph as a function from pixel coordinates to colour."""

import copy
from pathlib import Path
from typing import Annotated

import numpy as np
import skimage.data
import torch
from annotated_types import Interval
from PIL import Image
from torch import Tensor

from qnerf.config.bounds import Count
from qnerf.scenes import SCENES
from qnerf.scenes.base import hold_out
from qnerf.scenes.folders import PHOTOGRAPHS, SceneFolder
from qnerf.scenes.images import open_header, read_images
from qnerf.signals.base import Fitted, Signal
from qnerf.training.evaluation import shade_error
from qnerf.training.image_metrics import explained, psnr, ssim

BUNDLED = Path(skimage.data.__file__).parent
LUMINANCE = (0.2125, 0.7154, 0.0721)  # as skimage.color.rgb2gray


@SCENES.register("photograph")
class Photograph(Signal):
    """A picture that comes with scikit-image, or any image file.

    The model maps the centres of pixels, in the unit square with x to the right and y down, to colours in [0, 1].

    Args:
        path: an image file, or the name of a picture of scikit-image, such as astronaut, camera or coffee.
        size: the middle square of the picture is reduced to `size` x `size` pixels, by Pillow's antialiased bilinear
            filter; None: the whole picture in its own size.
        gray: one channel, luminance, instead of three.
        held_out: share of the pixels that training never sees. 0: training sees all of them, as in the published
            experiments (arXiv:2406.03873, arXiv:2508.10900).

    Raises:
        ValueError: no such picture, or one that cannot be read.
    """

    headline = "psnr"

    def __init__(
        self,
        *,
        path: str = "astronaut",
        size: Annotated[int, Interval(ge=3, le=1024)] | None = 32,
        gray: bool = False,
        held_out: Annotated[float, Interval(ge=0, le=0.9)] = 0.0,
    ) -> None:
        file = picture_file(path)
        header = open_header(file.parent, file)
        images, hashes = read_images(file.parent, [header], [(header.width, header.height)], 1)
        image = Image.fromarray(images[0, ..., :3])
        self.name = Path(path).name
        self.fingerprint = hashes[0]
        if size is not None:
            image = middle_square(image, size)
        pixels = np.asarray(image, np.float64) / 255
        if gray:
            pixels = pixels @ np.array(LUMINANCE)[:, None]
        self.truth = torch.from_numpy(pixels)  # (H, W, C)
        height, width = pixels.shape[:2]
        y, x = torch.meshgrid(centres(height), centres(width), indexing="ij")
        self.everywhere = torch.stack([x, y], dim=-1).view(-1, 2)
        unseen = round(held_out * height * width)
        order = torch.randperm(height * width, generator=torch.Generator().manual_seed(0))
        self.unseen, seen = order[:unseen].sort().values, order[unseen:].sort().values
        self.measured = torch.arange(height * width)  # pixels: all, or without those of the test
        self._train_on(seen)

    def _train_on(self, seen: Tensor) -> None:
        self.points, self.targets = self.everywhere[seen], self.truth.flatten(0, 1)[seen]
        self.seen = seen

    @property
    def tests_unseen(self) -> bool:
        return len(self.unseen) > 0

    def validating(self, share: float) -> "Photograph":
        """The picture without the pixels of the test, which are black; of the others some validate."""
        found = copy.copy(self)
        seen, unseen = (torch.tensor(pixels) for pixels in hold_out(self.seen.tolist(), share))
        found.measured, found.unseen, found.truth = self.seen, unseen, self.truth.clone()
        found.truth.flatten(0, 1)[self.unseen] = 0
        found._train_on(seen)
        return found

    def terms(self, predicted: Tensor, targets: Tensor) -> dict[str, Tensor]:
        return {"mse": torch.nn.functional.mse_loss(predicted, targets)}

    def evaluate(self, fitted: Fitted) -> tuple[dict[str, float | None], list[Tensor]]:
        """PSNR and SSIM of the whole picture, and the PSNR of the pixels that training never saw.

        Where pixels are held out for validation, those of the test are in none, and there is no SSIM.
        """
        color = fitted.values(self.everywhere).clamp(0, 1).view(self.truth.shape)
        fit, truth = color.expand(-1, -1, 3), self.truth.expand(-1, -1, 3)
        whole, unseen = (
            [image.reshape(1, -1, 3)[:, pixels] for image in (fit, truth)] for pixels in (self.measured, self.unseen)
        )
        measured = {
            "psnr": psnr(*whole),
            "ssim": ssim(fit, truth) if len(self.measured) == len(self.everywhere) else None,
            "explained": explained(*(image[0] for image in whole)),
            "psnr_unseen": psnr(*unseen) if len(self.unseen) else None,
        }
        return measured, [truth, fit, shade_error(fit, truth)]


def picture_file(path: str) -> Path:
    """The image file: `path`, or the picture of scikit-image with that name."""
    file = Path(path)
    if file.is_file():
        return file
    if file.name == path and path and (found := SceneFolder(BUNDLED).image(path)) is not None:
        return found
    known = sorted(file.stem for file in BUNDLED.iterdir() if file.suffix in PHOTOGRAPHS)
    raise ValueError(f"no image file {path}, and no picture of scikit-image; known: {', '.join(known)}")


def middle_square(image: Image.Image, size: Count) -> Image.Image:
    """The largest square in the middle of the image, `size` x `size` pixels."""
    side = min(image.size)
    left, top = (image.width - side) / 2, (image.height - side) / 2
    box = (left, top, left + side, top + side)
    return image.resize((size, size), Image.Resampling.BILINEAR, box)


def centres(count: int) -> Tensor:
    """(count,) float64: the middles of `count` equal parts of [0, 1].

    >>> centres(2).tolist()
    [0.25, 0.75]
    """
    return (torch.arange(count, dtype=torch.float64) + 0.5) / count
