"""Every option of every component declares what it accepts."""

from typing import Literal, get_args, get_origin

import pytest

import qnerf.scenes
from qnerf.config.bounds import check
from qnerf.config.registry import options_of
from qnerf.encoders import DIRECTIONS, ENCODERS
from qnerf.geometry.contraction import CONTRACTIONS
from qnerf.geometry.pose_refinement import CAMERAS
from qnerf.heads import HEADS
from qnerf.heads.activations import COLOR_ACTIVATIONS, DENSITY_ACTIVATIONS
from qnerf.quantum import QuantumLayer
from qnerf.quantum.circuit import ANSATZE
from qnerf.quantum.initial_angles import INITS
from qnerf.rendering.samplers import SAMPLERS
from qnerf.rendering.shading import SHADINGS
from qnerf.rendering.spacing import SPACINGS
from qnerf.training.image_metrics import IMAGE_METRICS

REGISTRIES = (
    ANSATZE, CAMERAS, COLOR_ACTIVATIONS, CONTRACTIONS, DENSITY_ACTIVATIONS, DIRECTIONS, ENCODERS, HEADS, IMAGE_METRICS,
    INITS, SAMPLERS, qnerf.scenes.SCENES, SHADINGS, SPACINGS,
)  # fmt: skip
NAMES = {"ansatz", "init", "spacing", "path", "images", "model", "device"}
"""Options whose text is checked elsewhere: names in a registry, folders, a device of PennyLane."""
COMPONENTS = {
    f"{registry.group}={name}": registry.get(name)
    for registry in REGISTRIES
    for name in registry.names()
    if registry.get(name).__module__.startswith("qnerf.")
} | {"QuantumLayer": QuantumLayer}
OPTIONS = [
    (f"{where}: {option}", option, hint)
    for where, component in COMPONENTS.items()
    for option, (_, hint) in options_of(component).items()
]


def parts(hint):
    """The types in an annotation that a value or an element may have; bounded ones are left out."""
    if get_origin(hint) is Literal or any(hasattr(item, "__iter__") or hasattr(item, "ge") for item in limits(hint)):
        inner = get_args(hint)[0] if limits(hint) else None
        return parts(inner) if get_origin(inner) in (list, tuple) else []
    if get_args(hint):
        return [part for argument in get_args(hint) if argument is not Ellipsis for part in parts(argument)]
    return [hint]


def limits(hint):
    return getattr(hint, "__metadata__", ())


def test_every_option_has_bounds_or_choices():
    for where, option, hint in OPTIONS:
        free = [part for part in parts(hint) if part in (int, float) or (part is str and option not in NAMES)]
        assert not free or option == "ansatz_options", f"{where} accepts any {free}"


def test_options_accept_no_number_without_meaning():
    for _, option, hint in OPTIONS:
        for value in (2**63, -(2**64), 1e300, float("nan"), float("inf")):
            with pytest.raises(ValueError, match=option):
                check(option, value, hint)


@pytest.mark.parametrize("options", [{"qiren": {"scale": float("nan")}}, {"qiren": {"turns": 1}}, {"cnott": {}}])
def test_options_of_every_ansatz_are_checked_also_of_those_that_are_not_chosen(options):
    with pytest.raises(ValueError, match="ansatz"):
        HEADS.build("qiren", 3, 3, qubits=2, ansatz="cnot", ansatz_options=options)
