"""Tables over seeds, as DataFrame, Markdown, LaTeX or CSV: `qnerf tables runs --rows field,color`."""

from .ablation import ablation
from .resources import resources
from .scenes import across_scenes
from .stability import stability
from .table import Table
from .units import units
