"""The figures: each one function that takes the DataFrame of `load.runs` (or a run's folder) and returns a Figure.

Beside each stands the function that computes what it draws, as a DataFrame. `python -m analysis.figures STORE` draws
all of them.
"""

from collections.abc import Callable
from functools import partial

import pandas as pd
from matplotlib.figure import Figure

from ..style import save
from .accuracy import accuracy_points, accuracy_vs_speed
from .capacity import capacity_points, capacity_vs_psnr, hash_configurations, hash_points
from .colors import hsv_boxes, hsv_histograms, hsv_samples, hsv_study
from .curves import loss_curves, loss_points, psnr_vs_time, time_points
from .encodings import encoding_channels, encoding_slices
from .ladder import ladder_points, speed_error_ladder
from .pareto import engine_points, engine_speed_vs_error, front, speed_points, speed_vs_error
from .plateaus import barren_plateaus, plateau_points
from .probed import best_of
from .psnr_vs_conditions import hardware_points, psnr_vs_noise, psnr_vs_shots
from .qualitative import qualitative_grid, qualitative_panels, typical
from .sampling import ray_samples, sampling_strategies
from .shape import psnr_vs_depth, psnr_vs_width, shape_points
from .spectrum import fourier_spectrum, spectrum_points


def _of_best(draw: Callable[..., Figure], probe: str) -> Callable[..., Figure]:
    """The figure of the best run that has the probe."""
    return lambda frame, **options: draw(best_of(frame, probe), **options)


FIGURES: dict[str, tuple[str, Callable[..., Figure]]] = {
    "capacity": ("PSNR against the parameters of both heads, SSIM as colour", capacity_vs_psnr),
    "capacity_color": ("PSNR against the parameters of the colour head", partial(capacity_vs_psnr, part="color")),
    "capacity_density": ("PSNR against the parameters of the density head", partial(capacity_vs_psnr, part="density")),
    "depth": ("PSNR against the depth of the colour head", psnr_vs_depth),
    "width": ("PSNR against the width of the colour head", psnr_vs_width),
    "density_width": ("PSNR against the width of the density head", partial(psnr_vs_width, head="density")),
    "hash": ("PSNR of the hash tables C1 to C7", hash_configurations),
    "loss": ("Training and evaluation loss", loss_curves),
    "time": ("PSNR against wall time", psnr_vs_time),
    "speed": ("Step time against PSNR with the Pareto front", speed_vs_error),
    "engines": ("Engine time against numerical error", lambda frame, **options: engine_speed_vs_error(**options)),
    "accuracy": ("Numerical error against time of each part", lambda frame, **options: accuracy_vs_speed(**options)),
    "ladder": ("Speed against error, rung by rung", lambda frame, **options: speed_error_ladder(**options)),
    "plateaus": ("Variance of gradients against wires", lambda frame, **options: barren_plateaus(**options)),
    "qualitative": ("Truth, render, error, depth of chosen runs", qualitative_grid),
    "hsv": ("Hue, saturation, value of truth, classical, quantum", hsv_study),
    "sampling": ("Sampling strategies along a ray", _of_best(sampling_strategies, "rays")),
    "encodings": ("First eight channels of each encoding", _of_best(encoding_channels, "encoding")),
    "spectrum": ("Fourier spectrum of a trained head", _of_best(fourier_spectrum, "spectrum")),
    "shots": ("PSNR against shots", psnr_vs_shots),
    "noise": ("PSNR against gate noise", psnr_vs_noise),
}
"""Name -> title, function of the runs' DataFrame."""

ONE_SCENE = ("hsv", "sampling", "encodings", "spectrum")
"""Figures that speak of one scene: of several, each gets its own."""


def scenes_of(name: str, frame: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """File name -> the runs to draw."""
    if name not in ONE_SCENE or frame["scene_name"].nunique() < 2:
        return {name: frame}
    return {f"{name}_{scene}": own for scene, own in frame.groupby("scene_name")}


__all__ = [
    "FIGURES",
    "accuracy_points",
    "accuracy_vs_speed",
    "barren_plateaus",
    "capacity_points",
    "capacity_vs_psnr",
    "encoding_channels",
    "encoding_slices",
    "engine_points",
    "engine_speed_vs_error",
    "fourier_spectrum",
    "front",
    "hardware_points",
    "hash_configurations",
    "hash_points",
    "hsv_boxes",
    "hsv_histograms",
    "hsv_samples",
    "hsv_study",
    "ladder_points",
    "loss_curves",
    "loss_points",
    "plateau_points",
    "psnr_vs_depth",
    "psnr_vs_noise",
    "psnr_vs_shots",
    "psnr_vs_time",
    "psnr_vs_width",
    "qualitative_grid",
    "qualitative_panels",
    "ray_samples",
    "sampling_strategies",
    "save",
    "scenes_of",
    "shape_points",
    "spectrum_points",
    "speed_error_ladder",
    "speed_points",
    "speed_vs_error",
    "time_points",
    "typical",
]
