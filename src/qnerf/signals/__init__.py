"""Signals: functions of coordinates that one head learns by itself, in a minute, beside radiance fields.

    scene -> points -> model (encoder, head, activation) -> loss -> metrics

A photograph is a function from pixel coordinates to colour, a shape one from points to the distance of its surface,
tones one to waves of known frequencies.
"""

from qnerf.scenes import SCENES
from qnerf.signals.base import Signal
from qnerf.signals.distance import Distance  # each registers its entry
from qnerf.signals.lattice import Lattice
from qnerf.signals.model import SignalModel, build_signal_model
from qnerf.signals.photograph import Photograph
from qnerf.signals.tones import Tones
from qnerf.signals.training import Fitted, SignalEvaluator, SignalTrainer

__all__ = [
    "SCENES",
    "Distance",
    "Fitted",
    "Lattice",
    "Photograph",
    "Signal",
    "SignalEvaluator",
    "SignalModel",
    "SignalTrainer",
    "Tones",
    "build_signal_model",
]
