"""Training steps by compiled loops against the same steps by plain PyTorch operations."""

import copy

import pytest
import torch

from qnerf.kernels import plain
from qnerf.kernels.dispatch import report
from qnerf.training import trainer as module
from tests.helpers.trainer import trainer

STEPS = 20  # of which the last ten are mostly steps in which the proposal networks do not learn
COMBINATIONS = {
    **{
        f"field={field} encoder={encoder}": None
        for field in ("classical", "qcolor", "qdensity")
        for encoder in ("hash", "pe")
    },
    "field=qboth shading=none density.activation=softplus": None,
    "field=classical shading=none render.background=random appearance=3 color.directions=sh": None,
    "field=classical contraction=box hash.features=3 render.background=white color.mlp.layers=1": None,
    "field=classical occupancy.every=2 occupancy.after=1 visibility.cameras=1 density.mlp.layers=3": None,
    "field=classical sampler=uniform sampler.samples=8 appearance=2": "UniformSampler has no loop",
    "field=classical shading=top appearance=2": "TopShading has no loop",
    "field=classical contraction=box cameras=so3xr3 hash.features=3": "refined poses",
}
"""Options, and why autograd goes through the loops one by one instead of the chain; None: it does not."""


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("overrides", COMBINATIONS)
def test_steps_of_compiled_loops_are_those_of_plain_operations(overrides, dtype, tiny, monkeypatch):
    """From the same state: losses to rounding, and gradients up to a ReLU that rounding flips in a single step."""
    gradients: list[dict[str, torch.Tensor]] = []

    def keep(optimiser):
        parts = {group["name"]: [one.grad for one in group["params"]] for group in optimiser.param_groups}
        gradients.append(
            {
                name: torch.cat([one.flatten().clone() for one in part if one is not None])
                for name, part in parts.items()
                if any(one is not None for one in part)
            }
        )
        apply_gradients(optimiser)

    apply_gradients = module.apply_gradients
    monkeypatch.setattr(module, "apply_gradients", keep)
    config = tiny(*overrides.split(), "train.rays=40", "train.steps=100", f"numerics.dtype={dtype}")
    fast, slow = trainer(config), trainer(config)
    errors: dict[str, list[float]] = {}
    close, closer = (3e-4, 1e-3) if dtype == "float32" else (1e-11, 1e-8)
    for step in range(STEPS):
        if step:
            slow.load(copy.deepcopy(fast.state()))
        with report() as aside:
            loss = fast.take_step(measure=True)["train/loss"]
        assert aside.get("whole step") == COMBINATIONS[overrides]
        with plain():
            expected = slow.take_step(measure=True)["train/loss"]
        assert loss == pytest.approx(expected, rel=close)
        ours, theirs = gradients[-2:]
        assert ours.keys() == theirs.keys()
        for part, gradient in theirs.items():
            error = float((ours[part] - gradient).norm() / gradient.norm().clamp(min=1e-12))
            errors.setdefault(part, []).append(error)
    assert {part for part, found in errors.items() if sorted(found)[STEPS // 2] > closer} == set(), errors


def transpose(taken):
    weight = taken.model.field.color_head.net[0].weight
    weight.data = weight.data.T.contiguous().T


def double_gradient(taken):
    taken.model.field.density_head.net[0].weight.register_hook(lambda gradient: 2 * gradient)


def freeze(taken):
    taken.model.field.density_head.net[0].bias.requires_grad_(False)


def shift_colors(taken):
    taken.model.field.color_head.register_forward_hook(lambda _module, _given, values: values + 1)


def square_loss(taken):
    terms = taken.loss_terms
    taken.loss_terms = lambda *given: {name: term.square() for name, term in terms(*given).items()}


CHANGES = {
    transpose: "parameters in another order in memory",
    double_gradient: "hooks on parameters",
    freeze: "parameters that do not learn",
    shift_colors: "hooks on MLPHead",
    square_loss: "another loss",
}


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
def test_what_is_done_to_a_model_between_steps_acts(change, tiny):
    config = tiny("field=classical", "train.rays=40", "train.steps=100", "numerics.dtype=float64")
    fast, slow = trainer(config), trainer(config)
    for step in range(4):
        if step == 1:
            change(fast), change(slow)
        with report() as aside:
            loss = fast.take_step(measure=True)["train/loss"]
        assert aside.get("whole step") == (CHANGES[change] if step else None)
        with plain():
            assert loss == pytest.approx(slow.take_step(measure=True)["train/loss"], rel=1e-9)
