"""Waves whose frequencies are known, so that what a head can and cannot learn shows octave by octave."""

from typing import Annotated, Literal

import numpy as np
import torch
from annotated_types import Interval
from scipy.fft import idctn
from torch import Tensor

from qnerf.config.bounds import PositiveInt, Seed
from qnerf.scenes import SCENES
from qnerf.scenes.base import digest
from qnerf.signals.base import Fitted
from qnerf.signals.lattice import HeldOut, Lattice
from qnerf.training.evaluation import shade_error
from qnerf.training.image_metrics import explained, octave_errors, octaves_of


@SCENES.register("tones")
class Tones(Lattice):
    """A sum of waves, of equal energy in each octave of frequency, on a line or a square (after arXiv:1806.08734).

    The waves are those of the cosine transform by which `error_octave_<k>` measures, so each lies in one octave alone.
    Their frequencies within the octave, their directions and signs are random. Values have mean 0 and variance 1.

    Args:
        dims: 1, a line, or 2, a square.
        octaves: the highest frequency is below 2^octaves cycles a side.
        waves: in each octave; fewer where it has no more.
        size: points along a side, at least 2^(octaves + 1).
        seed: of frequencies, directions and signs.
        held_out: share of the points that training never sees. 0: training sees all.
    """

    headline = "explained"

    def __init__(
        self,
        *,
        dims: Literal[1, 2] = 1,
        octaves: Annotated[int, Interval(ge=1, le=8)] = 6,
        waves: PositiveInt = 2,
        size: Annotated[int, Interval(ge=4, le=1024)] = 128,
        seed: Seed = 0,
        held_out: HeldOut = 0.0,
    ) -> None:
        if size < (least := 2 ** (octaves + 1)):
            raise ValueError(f"scene.size={size}: expected at least {least} points a side for scene.octaves={octaves}")
        self.name = f"tones{dims}d"
        self.fingerprint = digest("tones 1")
        random = np.random.default_rng(seed)
        spectrum = np.zeros((size,) * dims)
        of = octaves_of(spectrum.shape)
        for octave in range(1, octaves + 1):
            places = random.permutation(np.argwhere(of == octave))[:waves]
            signs = random.choice([-1.0, 1.0], len(places))
            spectrum[tuple(places.T)] = signs * np.sqrt(spectrum.size / octaves / len(places))
        self.lay(torch.from_numpy(idctn(spectrum, norm="ortho"))[..., None], held_out)

    def evaluate(self, fitted: Fitted) -> tuple[dict[str, float | None], list[Tensor]]:
        """Explained variance of unseen points, where there are some, or of all, and the error in octaves of all."""
        values = fitted.values(self.everywhere)
        measured = self.unseen if self.tests_unseen else self.measured
        whole = self.truth.flatten(0, -2)
        octaves = octave_errors(values.view(self.truth.shape), self.truth) if self.is_whole else {}
        side = self.truth.shape[0]
        panels = [
            (0.5 + part.view(*self.truth.shape[:-1]) / 6).clamp(0, 1).expand(side, side) for part in (whole, values)
        ]
        truth, fit = (panel[..., None].expand(-1, -1, 3) for panel in panels)
        return {"explained": explained(values[measured], whole[measured]), **octaves}, [
            truth,
            fit,
            shade_error(fit, truth),
        ]
