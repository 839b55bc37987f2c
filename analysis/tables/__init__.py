"""Tables over seeds, as DataFrame, Markdown, LaTeX or CSV: `python -m analysis.tables runs --rows field,color`."""

from .ablation import ablation, markdown
from .hardware import hardware
from .needs import needs
from .seeds import over_seeds
from .stability import stability
from .table import Table
from .units import units
from .values import VALUES, Value

__all__ = ["VALUES", "Table", "Value", "ablation", "hardware", "markdown", "needs", "over_seeds", "stability", "units"]
