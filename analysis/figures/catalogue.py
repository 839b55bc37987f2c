"""Every figure that can be asked for by name, declared once: its title, its function, and what it is drawn from."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from ..selection import by_scene
from .budgets import psnr_vs_time
from .capacity import capacity_vs_psnr
from .curves import loss_curves, octave_errors
from .forest import forest
from .pareto import speed_vs_error
from .probed import best_of
from .qualitative import qualitative_grid
from .shots_and_noise import psnr_vs_noise, psnr_vs_shots
from .spectrum import fourier_spectrum
from .stand_ins import stand_ins


@dataclass(frozen=True)
class Entry:
    """A figure that can be asked for by name.

    function: takes the DataFrame of `load.runs`; or the folder of one run, if `probe` names the table that `qnerf
        probe` has to write for it.
    options: keyword arguments of `function`. trained: it needs models, pictures or curves of runs that qnerf trained.
    """

    title: str
    function: Callable[..., Figure]
    options: Mapping[str, str] = field(default_factory=dict)
    probe: str = ""
    trained: bool = True

    def draw(self, runs: pd.DataFrame, **judged: Any) -> Figure:
        """The figure of these runs, or of the best probed one. Raises ValueError with what is missing.

        judged: baseline, metric and within of `forest` and `stand_ins`, which other figures do not have; None: theirs.
        """
        given = judged if self.function in (forest, stand_ins) else {}
        options = {name: value for name, value in given.items() if value is not None}
        if not self.suits(runs):
            raise ValueError("only for trainings of qnerf; these runs are of other programs")
        source = best_of(runs, self.probe) if self.probe else runs
        return self.function(source, **self.options, **options)

    def suits(self, runs: pd.DataFrame) -> bool:
        return not self.trained or bool(runs["encoder"].notna().any())  # every run that qnerf trains has one

    def scenes(self, name: str, runs: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """Name of a figure -> the runs it shows: `name` with all runs, or <name>_<scene> with the runs of a scene."""
        if not self.probe or runs["scene_name"].nunique() < 2:
            return {name: runs}
        return {f"{name}_{scene}": own for scene, own in by_scene(runs).items()}


_COLOR, _DENSITY = {"part": "color"}, {"part": "density"}

FIGURES = {
    "capacity": Entry("PSNR against the parameters of both heads, coloured by SSIM", capacity_vs_psnr),
    "capacity_color": Entry("PSNR against the parameters of the colour head", capacity_vs_psnr, _COLOR),
    "capacity_density": Entry("PSNR against the parameters of the density head", capacity_vs_psnr, _DENSITY),
    "loss": Entry("Loss in training and on held-out views", loss_curves),
    "octaves": Entry("Error in each octave of spatial frequency", octave_errors),
    "time": Entry("PSNR against the time of whole trainings", psnr_vs_time),
    "speed": Entry("PSNR against step time, with the Pareto front", speed_vs_error),
    "forest": Entry("Differences from the baseline, scene by scene", forest, trained=False),
    "stand_ins": Entry("A circuit head and its stand-ins, with verdicts", stand_ins),
    "qualitative": Entry("Truth, render, error and depth of typical runs", qualitative_grid),
    "spectrum": Entry("Fourier spectrum of a trained head", fourier_spectrum, probe="spectrum"),
    "shots": Entry("PSNR against shots", psnr_vs_shots),
    "noise": Entry("PSNR against gate noise", psnr_vs_noise),
}
"""Name -> figure, in the order of the report."""
