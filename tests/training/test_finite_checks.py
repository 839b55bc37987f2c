"""`numerics.finite_checks=true` names where the first value that is not finite arose."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import nn

from qnerf import experiment
from qnerf.building.configuration import Configuration
from qnerf.records import read_status, runs
from qnerf.training.finite_checks import check_every_value
from qnerf.training.trainer import Diverged, Loop
from tests.helpers.trainer import trainer

Tiny = Callable[..., dict[str, Any]]
SMALL = ("qiren=1L1S", "qiren.qubits=3")


def spoilt(parameter: str, value: float = math.nan) -> Callable[[Loop], None]:
    """Puts a value into the last entry of a parameter."""

    def spoil(taken: Loop) -> None:
        with torch.no_grad():
            taken.model.get_parameter(parameter).view(-1)[-1] = value

    return spoil


def spoilt_gradient(parameter: str) -> Callable[[Loop], None]:
    return lambda taken: taken.model.get_parameter(parameter).register_hook(lambda gradient: gradient * math.nan)


def spoilt_optimiser(taken: Loop) -> None:
    taken.take_step(measure=False)
    taken.optimiser.state[taken.model.field.color_head.readout.bias]["exp_avg_sq"][1] = math.nan


def spoilt_rays(taken: Loop) -> None:
    taken.table.directions[:, 1] = math.nan


FIRST: dict[str, tuple[list[str], Callable[[Loop], None]]] = {
    "nan in the inputs of the model.directions, 24 of 24 values, at step 0": (["field=classical"], spoilt_rays),
    "nan in the outputs of field.density_head.net.2, ": (
        ["field=classical", "visibility.cameras=0"],
        spoilt("field.density_head.net.2.bias"),
    ),
    "nan in the inputs of field.color_head.hybrid.0.norm, ": (
        ["field=qcolor"],
        spoilt("field.color_head.hybrid.0.linear.bias"),
    ),
    "inf in the outputs of sampler.networks.1.out, ": (
        ["field=classical"],
        spoilt("sampler.networks.1.out.bias", math.inf),
    ),
    "nan in the gradient of field.density_head.readout.weight, ": (
        ["field=qboth"],
        spoilt_gradient("field.density_head.readout.weight"),
    ),
    "nan in field.color_head.readout.bias after the update, 1 of 3 values, at step 1": (
        ["field=qcolor"],
        spoilt_optimiser,
    ),
    "nan in the outputs of field.appearance, ": (
        ["field=classical", "appearance=2"],
        lambda taken: nn.init.constant_(taken.model.field.appearance.weight, math.nan),
    ),
}


def test_the_first_value_that_is_not_finite_is_named_in_one_line(tiny: Tiny) -> None:
    for message, (options, spoil) in FIRST.items():
        taken = trainer(tiny(*SMALL, *options))
        check_every_value(taken)
        spoil(taken)
        with pytest.raises(Diverged) as caught:
            taken.take_step(measure=False)
        assert message in str(caught.value)
        assert "\n" not in str(caught.value)


def test_an_infinite_density_of_a_proposal_network_is_allowed(tiny: Tiny) -> None:
    taken = trainer(tiny("field=classical"))
    check_every_value(taken)
    spoilt("sampler.networks.0.out.bias", 200.0)(taken)
    taken.take_step(measure=False)
    assert taken.step == 1


def test_checks_change_numbers_by_rounding_at_most(tiny: Tiny) -> None:
    overrides = (*SMALL, "field=qboth", "cameras=se3", "shading=none", "train.distortion=0.01")
    looked, plain = trainer(tiny(*overrides)), trainer(tiny(*overrides))
    check_every_value(looked)
    for _ in range(3):
        expected = plain.take_step(measure=True)["train/loss"]
        assert looked.take_step(measure=True)["train/loss"] == pytest.approx(expected, rel=1e-4)


def test_a_run_that_diverges_goes_on_with_checks_and_names_the_part(tiny: Tiny) -> None:
    options = ("field=classical", "train.lr=1e6", "train.lr_final=1e6", "color.mlp.layers=8", "train.steps=8")
    config = tiny(*options)
    with pytest.raises(Diverged, match="the same command with numerics"):
        experiment.run(config)
    checked = tiny(*options, "numerics.finite_checks=true")
    assert Configuration.of(config).decisive == Configuration.of(checked).decisive
    with pytest.raises(Diverged, match=r" in the (in|out)puts of ") as caught:
        experiment.run(checked)
    (folder,) = runs(config["store"])
    assert read_status(folder)["error"] == str(caught.value)
