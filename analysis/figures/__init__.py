"""The figures, each a function that returns a matplotlib Figure.

Most take the DataFrame of `load.runs`, some the folder of one run; `FIGURES` lists them by name. Beside each stands the
function that computes what it draws, as a DataFrame. `qnerf figures STORE` draws all of them.
"""

from ..style import save
from .budgets import psnr_vs_time, time_points
from .capacity import capacity_points, capacity_vs_psnr
from .catalogue import FIGURES, Entry
from .curves import loss_curves, loss_points, octave_errors, octave_points
from .forest import forest
from .pareto import front, speed_points, speed_vs_error
from .probed import best_of
from .qualitative import qualitative_grid, qualitative_panels, typical
from .shots_and_noise import hardware_points, psnr_vs_noise, psnr_vs_shots
from .spectrum import fourier_spectrum, spectrum_points
from .stand_ins import cheapest, stand_in_points, stand_ins
