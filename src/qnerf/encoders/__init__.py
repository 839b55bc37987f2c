"""Points -> features, and view directions -> features."""

from qnerf.encoders.directions import DIRECTIONS, RawDirections, SphericalHarmonics, spherical_harmonics
from qnerf.encoders.frequency import FourierFeatures, PositionalEncoding
from qnerf.encoders.hash import HashEncoder, level_resolutions
from qnerf.encoders.identity import Identity
from qnerf.encoders.registry import ENCODERS, Encoder

__all__ = [
    "DIRECTIONS",
    "ENCODERS",
    "Encoder",
    "FourierFeatures",
    "HashEncoder",
    "Identity",
    "PositionalEncoding",
    "RawDirections",
    "SphericalHarmonics",
    "level_resolutions",
    "spherical_harmonics",
]
