"""A photograph as a function from pixel coordinates to colour."""

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
from qnerf.scenes.folders import PHOTOGRAPHS, SceneFolder
from qnerf.scenes.images import open_header, read_images
from qnerf.signals.base import Fitted
from qnerf.signals.lattice import HeldOut, Lattice
from qnerf.training.evaluation import shade_error
from qnerf.training.image_metrics import explained, octave_errors, psnr, ssim

BUNDLED = Path(skimage.data.__file__).parent
LUMINANCE = (0.2125, 0.7154, 0.0721)  # as skimage.color.rgb2gray


@SCENES.register("photograph")
class Photograph(Lattice):
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
        held_out: HeldOut = 0.0,
    ) -> None:
        file = picture_file(path)
        header = open_header(file.parent, file)
        images, hashes = read_images(file.parent, [header], [(header.width, header.height)])
        image = Image.fromarray(images[0, ..., :3])
        self.name = Path(path).name
        self.fingerprint = hashes[0]
        if size is not None:
            image = middle_square(image, size)
        pixels = np.asarray(image, np.float64) / 255
        if gray:
            pixels = pixels @ np.array(LUMINANCE)[:, None]
        self.lay(torch.from_numpy(pixels), held_out)  # (H, W, C)

    def evaluate(self, fitted: Fitted) -> tuple[dict[str, float | None], list[Tensor]]:
        """PSNR, SSIM and octaves of the whole picture, and the PSNR of the pixels that training never saw.

        Where pixels are held out for validation, those of the test are in none, and there are no SSIM and octaves.
        """
        color = fitted.values(self.everywhere).clamp(0, 1).view(self.truth.shape)
        fit, truth = color.expand(-1, -1, 3), self.truth.expand(-1, -1, 3)
        whole, unseen = (
            [image.reshape(1, -1, 3)[:, pixels] for image in (fit, truth)] for pixels in (self.measured, self.unseen)
        )
        measured = {
            "psnr": psnr(*whole),
            "ssim": ssim(fit, truth) if self.is_whole else None,
            "explained": explained(*(image[0] for image in whole)),
            "psnr_unseen": psnr(*unseen) if len(self.unseen) else None,
            **(octave_errors(color, self.truth) if self.is_whole else {}),
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
