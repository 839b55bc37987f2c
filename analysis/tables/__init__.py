"""Tables over seeds, as DataFrame, Markdown, LaTeX or CSV: `python -m analysis.tables runs --rows field,color`."""

from analysis.tables.ablation import ablation, markdown
from analysis.tables.hardware import hardware
from analysis.tables.needs import needs
from analysis.tables.seeds import over_seeds
from analysis.tables.stability import stability
from analysis.tables.table import Table
from analysis.tables.units import units
from analysis.tables.values import VALUES, Value

__all__ = ["VALUES", "Table", "Value", "ablation", "hardware", "markdown", "needs", "over_seeds", "stability", "units"]
