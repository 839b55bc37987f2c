"""Every figure that can be asked for by name, declared once: its title, its function, and what it is drawn from."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import pandas as pd
from matplotlib.figure import Figure

from .accuracy import accuracy_vs_speed
from .capacity import capacity_vs_psnr, hash_configurations
from .colors import hsv_study
from .curves import loss_curves, psnr_vs_time
from .encodings import encoding_channels
from .ladder import speed_error_ladder
from .pareto import engine_speed_vs_error, speed_vs_error
from .plateaus import barren_plateaus
from .probed import best_of
from .qualitative import qualitative_grid
from .sampling import sampling_strategies
from .shape import psnr_vs_depth, psnr_vs_width
from .shots_and_noise import psnr_vs_noise, psnr_vs_shots
from .spectrum import fourier_spectrum


@dataclass(frozen=True)
class Entry:
    """A figure that can be asked for by name.

    takes: what `function` is called with: the DataFrame of `load.runs`, the folder of one run, or nothing, to draw the
        saved results of a benchmark.
    probe: the table that `qnerf probe` has to write for that run.
    options: keyword arguments of `function`.
    paper: the paper's figure that it corresponds to.
    one_scene: whether each scene gets a figure of its own.
    hint: the command that trains the runs it needs, if its error messages do not name one.
    """

    title: str
    function: Callable[..., Figure]
    takes: Literal["runs", "run", "benchmark"] = "runs"
    probe: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    paper: str = ""
    one_scene: bool = False
    hint: str = ""

    def draw(self, runs: pd.DataFrame, **options: Any) -> Figure:
        """The figure of these runs; one that takes a single run draws the best that was probed.

        Raises ValueError with what is missing if it cannot be drawn.
        """
        options = {**self.options, **options}
        if self.takes == "benchmark":
            return self.function(**options)
        return self.function(best_of(runs, self.probe) if self.takes == "run" else runs, **options)

    def scenes(self, name: str, runs: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """Name of a figure -> the runs it shows: `name` with all runs, or <name>_<scene> with those of a scene."""
        if not self.one_scene or runs["scene_name"].nunique() < 2:
            return {name: runs}
        return {f"{name}_{scene}": own for scene, own in runs.groupby("scene_name")}


_CAPACITY = "Architecture-capacity comparison"
_MLPS = "RGB MLP performance"
_WIDTHS = "`qnerf run -m {head}.width=16,32,64` trains some"

FIGURES = {
    "capacity": Entry("PSNR against the parameters of both heads, coloured by SSIM", capacity_vs_psnr, paper=_CAPACITY),
    "capacity_color": Entry(
        "PSNR against the parameters of the colour head", capacity_vs_psnr, options={"part": "color"}, paper=_CAPACITY
    ),
    "capacity_density": Entry(
        "PSNR against the parameters of the density head",
        capacity_vs_psnr,
        options={"part": "density"},
        paper=_CAPACITY,
    ),
    "depth": Entry(
        "PSNR against the depth of the colour head",
        psnr_vs_depth,
        paper=_MLPS,
        hint="`qnerf run -m field=qcolor qiren.layers=1,2,3` trains some",
    ),
    "width": Entry(
        "PSNR against the width of the colour head", psnr_vs_width, paper=_MLPS, hint=_WIDTHS.format(head="color")
    ),
    "density_width": Entry(
        "PSNR against the width of the density head",
        psnr_vs_width,
        options={"head": "density"},
        paper=_CAPACITY,
        hint=_WIDTHS.format(head="density"),
    ),
    "hash": Entry(
        "PSNR of the hash tables C1 to C7",
        hash_configurations,
        paper="Hash encoding configurations",
        hint="`qnerf run -m hash=C1,C3,C5,C7` trains some",
    ),
    "loss": Entry("Loss in training and on held-out views", loss_curves, paper="Training and evaluation loss"),
    "time": Entry("PSNR against wall time", psnr_vs_time),
    "speed": Entry("PSNR against step time, with the Pareto front", speed_vs_error),
    "engines": Entry("Numerical error of each engine against its time", engine_speed_vs_error, "benchmark"),
    "accuracy": Entry("Numerical error of each part against its time", accuracy_vs_speed, "benchmark"),
    "ladder": Entry("Speed against error, rung by rung", speed_error_ladder, "benchmark"),
    "plateaus": Entry("Variance of gradients against wires", barren_plateaus, "benchmark"),
    "qualitative": Entry(
        "Truth, render, error and depth of typical runs", qualitative_grid, paper="Qualitative comparison"
    ),
    "hsv": Entry(
        "Hue, saturation and value of truth, classical and quantum renderings",
        hsv_study,
        paper="HSV color space analysis",
        one_scene=True,
        hint="`qnerf run -m field=classical,qcolor` trains both kinds",
    ),
    "sampling": Entry(
        "Sampling strategies along a ray",
        sampling_strategies,
        "run",
        "rays",
        paper="Sampling strategies along a ray",
        one_scene=True,
    ),
    "encodings": Entry(
        "First eight channels of each encoding",
        encoding_channels,
        "run",
        "encoding",
        paper="NeRF encoding strategies",
        one_scene=True,
    ),
    "spectrum": Entry("Fourier spectrum of a trained head", fourier_spectrum, "run", "spectrum", one_scene=True),
    "shots": Entry("PSNR against shots", psnr_vs_shots),
    "noise": Entry("PSNR against gate noise", psnr_vs_noise),
}
"""Name -> figure, in the order of the report."""
