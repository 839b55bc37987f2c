"""Every figure that can be asked for by name, declared once: its title, its function, and what it is drawn from."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from .budgets import psnr_vs_time
from .capacity import capacity_vs_psnr
from .curves import loss_curves, octave_errors
from .forest import forest
from .qualitative import qualitative_grid
from .shots_and_noise import psnr_vs_noise, psnr_vs_shots
from .stand_ins import stand_ins


@dataclass(frozen=True)
class Entry:
    """A figure that can be asked for by name.

    function: takes the DataFrame of `load.runs`.
    options: keyword arguments of `function`. trained: it needs models, pictures or curves of runs that qnerf trained.
    """

    title: str
    function: Callable[..., Figure]
    options: Mapping[str, str] = field(default_factory=dict)
    trained: bool = True

    def draw(self, runs: pd.DataFrame, **judged: Any) -> Figure:
        """The figure of these runs. Raises ValueError with what is missing.

        judged: baseline, metric and within of `forest` and `stand_ins`, which other figures do not have; None: theirs.
        """
        given = judged if self.function in (forest, stand_ins) else {}
        options = {name: value for name, value in given.items() if value is not None}
        if not self.suits(runs):
            raise ValueError("only for trainings of qnerf; these runs are of other programs")
        return self.function(runs, **self.options, **options)

    def suits(self, runs: pd.DataFrame) -> bool:
        return not self.trained or bool(runs["encoder"].notna().any())  # every run that qnerf trains has one


_COLOR, _DENSITY = {"part": "color"}, {"part": "density"}

FIGURES = {
    "capacity": Entry("PSNR against the parameters of both heads, coloured by SSIM", capacity_vs_psnr),
    "capacity_color": Entry("PSNR against the parameters of the colour head", capacity_vs_psnr, _COLOR),
    "capacity_density": Entry("PSNR against the parameters of the density head", capacity_vs_psnr, _DENSITY),
    "loss": Entry("Loss in training and on held-out views", loss_curves),
    "octaves": Entry("Error in each octave of spatial frequency", octave_errors),
    "time": Entry("PSNR against the time of whole trainings", psnr_vs_time),
    "forest": Entry("Differences from the baseline, scene by scene", forest, trained=False),
    "stand_ins": Entry("A circuit head and its stand-ins, with verdicts", stand_ins),
    "qualitative": Entry("Truth, render, error and depth of typical runs", qualitative_grid),
    "shots": Entry("PSNR against shots", psnr_vs_shots),
    "noise": Entry("PSNR against gate noise", psnr_vs_noise),
}
"""Name -> figure, in the order of the report."""
