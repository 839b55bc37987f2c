"""Folders of the files beside the code: at the top of a checkout, or inside the package of an installed wheel.

`setup.py` maps the folders of a checkout into the package, so both have the same layout below `HOME`.
"""

from pathlib import Path

_PACKAGE = Path(__file__).parents[1]

HOME = _PACKAGE if (_PACKAGE / "conf").is_dir() else _PACKAGE.parents[1]
CONF = HOME / "conf"
"""Hydra's configuration groups."""
SWEEPS = HOME / "sweeps"
"""The sweeps of `qnerf run --sweep NAME`, one YAML each."""
