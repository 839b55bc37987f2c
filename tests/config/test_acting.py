"""Which settings have an effect."""

import pytest

from qnerf.building.acting import idle, what_acts
from qnerf.config.settings import only_acting
from tests.helpers.configs import composed


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("field=classical qiren.layers=1", "field=classical qiren.layers=2", True),
        ("field=qcolor qiren.layers=1", "field=qcolor qiren.layers=2", False),
        ("field=classical", "field=classical density=qfgn", False),
        ("density=qfgn qiren.gain=1", "density=qfgn qiren.gain=2", False),
        ("field=qcolor color.mlp.width=8", "field=qcolor color.mlp.width=16", True),
        ("field=classical color.degree=2", "field=classical color.degree=3", False),
        ("color.directions=raw color.degree=2", "color.directions=raw color.degree=3", True),
        ("encoder=pe hash=C1", "encoder=pe hash=C5", True),
        ("encoder=hash hash=C1", "encoder=hash hash=C5", False),
        ("threads=1 store=a", "threads=2 store=b", True),
        ("seed=0", "seed=1", False),
        ("train.lr=1e-2", "train.lr=2e-2", False),
    ],
)
def test_only_what_acts_tells_configurations_apart(one, other, same):
    first, second = (what_acts(composed(*typed.split())) for typed in (one, other))
    assert (first == second) is same


@pytest.mark.parametrize(
    ("typed", "without"),
    [
        ("field=qcolor color.directions=raw color.degree=2 color.direction_scale=0.5", ["color.degree=2"]),
        ("field=qcolor color.directions=sh color.degree=2 color.direction_scale=0.5", ["color.direction_scale=0.5"]),
        ("field=classical qiren.layers=1 ansatz=rx seed=1", ["qiren.layers=1", "ansatz=rx"]),
        ("field=qcolor qiren.layers=1 ansatz=rx color.qiren.gain=2 color.mlp.width=8", ["color.mlp.width=8"]),
        ("color=qfgn density=mlp qiren.layers=1 color.qiren.gain=2 qfgn.features=8", []),
        ("encoder=pe hash.levels=4 sampler=uniform proposal.final=8", ["hash.levels=4", "proposal.final=8"]),
        ("encoder=hash hash.levels=4 sampler=proposal proposal.final=8 color.activation=linear seed=1", []),
        ("scene=photograph head=mlp qiren.layers=1 head.mlp.width=8 head.activation=linear", ["qiren.layers=1"]),
    ],
)  # fmt: skip
def test_what_was_typed_and_has_no_effect(typed, without):
    overrides = typed.split()
    assert idle(only_acting(composed(*overrides)), overrides) == without
