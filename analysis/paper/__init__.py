"""The numbers printed in the Q-NeRF paper (arXiv:2512.12683), beside our runs of the same architectures."""

from .joined import SETTING
from .tables import (
    PAPER_TABLES,
    hash_encoding_configurations,
    quantum_density_and_rgb,
    rgb_predictors,
)
